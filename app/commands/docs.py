"""`svwfs docs`: the documentation in the terminal, and what to do about a message."""

from typing import Annotated

import typer

from app.errors import InputError


def docs(
    words: Annotated[
        list[str] | None, typer.Argument(metavar="PAGE|ENTRY|MESSAGE", help="Page, entry, or words of a message.")
    ] = None,
) -> None:
    """Print a page of the documentation, or what to do about a message.

    Without words, the pages are listed. The pages lie in the installed package, and need no network.

    Example: svwfs docs

    Example: svwfs docs no-dark-yet

    Example: svwfs docs "the light is off"
    """
    from app.documentation import anchor_of, documentation, entries, entry_of

    if (folder := documentation()) is None:
        raise InputError("the documentation is not installed: it is in the folder docs of the source")
    asked = " ".join(words or ())
    pages = {path.relative_to(folder).with_suffix("").as_posix(): path for path in sorted(folder.rglob("*.md"))}
    if not asked:
        titles = [f"{name:28} {path.read_text('utf-8').partition(chr(10))[0][2:]}" for name, path in pages.items()]
        typer.echo(f"{folder}\n" + "\n".join(titles))
    elif asked in pages:
        typer.echo(pages[asked].read_text("utf-8"))
    elif (anchor := anchor_of(asked)) in entries() or (anchor := entry_of(asked)):
        typer.echo(entries()[anchor])
    else:
        raise InputError(f"{asked}: no page and no message of svwfs; svwfs docs lists the pages")
