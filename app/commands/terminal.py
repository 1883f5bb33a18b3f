"""The terminal: progress bar, tables, sentences, warnings, and questions to the user."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from app.errors import InputError, Interrupted
from app.progress import LINE_START, LINES

if TYPE_CHECKING:
    from app.bench.config import Bench
    from app.results.run_summary import QualityTally
    from reconstruction.geometry import Field
    from reconstruction.registration.circulation import Circulation

_LEAST_WIDTH = 200  # characters of a table
LIGHT_BY_HAND = "the light is manual: make sure that it is off"


def printable(text: str) -> str:
    """Return a text in one line, without control codes that could change the terminal."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def hint(message: str, stream: TextIO) -> str:
    """Return which command explains a message, if a person reads the stream; else nothing."""
    from app.documentation import entry_of

    anchor = entry_of(message) if stream.isatty() else ""
    return f"  (svwfs docs {anchor})" if anchor else ""


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Progress bar on standard error, or lines for the program that asked for them; yields its callback."""
    if os.environ.get(LINES):
        yield lambda _, fraction: remind(f"{LINE_START}{fraction:.3f}")
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("starting", total=1.0)
        yield lambda text, fraction: progress.update(task, description=text or "waiting", completed=fraction)


@contextmanager
def analysing(source: Path, out: Path) -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar while `source` is analysed, and name it, or the file `out`, in errors."""
    from reconstruction.errors import ReconstructionError

    try:
        with progress_bar() as progress:
            yield progress
    except ReconstructionError as error:
        raise InputError(f"{source}: {error}") from error
    except Interrupted:
        raise Interrupted(f"interrupted: {out} is not written") from None


def print_sentence(text: str) -> None:
    """Print text that may come from a file."""
    import typer

    typer.echo(printable(text))


def print_warning(sentence: str) -> None:
    """Print a warning."""
    from rich.console import Console
    from rich.markup import escape

    text = f"[yellow]warning:[/] {escape(printable(sentence) + hint(sentence, sys.stdout))}"
    Console(highlight=False, emoji=False, soft_wrap=True).print(text)


def print_table(
    title: str | None, headings: Sequence[str], lines: Iterable[Sequence[str]], notes: Iterable[str] = ()
) -> None:
    """Print a table of cells with notes below it, never so narrow that a pipe cuts a number."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, box=box.SIMPLE, padding=(0, 1), pad_edge=False)
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="right" if index else "left", no_wrap=True)
    for line in lines:
        table.add_row(*line)
    Console(width=max(Console().width, _LEAST_WIDTH)).print(table)
    for note in notes:
        print_sentence(note)


def print_by_view(field: Field, title: str, cells: Iterable[Iterable[str]]) -> None:
    """Print a table of cells (view_row, view_column); where it is too wide, break before brackets."""
    from rich.console import Console
    from rich.table import Table

    texts, table, console = [list(row) for row in cells], Table(title=title), Console()
    widest = max(len(line) for row in texts for cell in row for line in cell.splitlines())
    if 14 + (3 + widest) * field.view_columns > console.width:  # with lines and margins
        texts = [[cell.replace(" (", "\n(") for cell in row] for row in texts]
    table.add_column("y \\ x (mm)", justify="right")
    for x_m in field.view_x_m:
        table.add_column(f"{x_m * 1e3:+.2f}", justify="right")
    inside = field.contains(field.view_x_m / field.half_width_m, field.view_y_m[:, None] / field.half_width_m)
    for y_m, row, is_inside in zip(field.view_y_m, texts, inside, strict=True):
        shown = (cell if lies else "outside" for cell, lies in zip(row, is_inside, strict=True))
        table.add_row(f"{y_m * 1e3:+.2f}", *shown)
    console.print(table)
    if not inside.all():
        console.print("outside: these views lie outside the circular field")


def print_rotation(rotation: Circulation, *, is_rotating: bool) -> None:
    """Print the rotation of the subimages, and a warning if it contradicts layers."""
    from app.results.run_summary import ROTATES, rotation_sentence

    print_sentence(rotation_sentence(rotation))
    if is_rotating:
        print_warning(ROTATES)


def print_quality(quality: QualityTally) -> None:
    """Print a warning for each fault of the frames, and a note of what could not be checked."""
    for sentence in quality.sentences:
        print_warning(f"doubtful: {sentence}")
    if quality.unjudged:
        print_sentence(f"note: {quality.unjudged}")


def print_missing_lines(source: Path) -> None:
    """Warn of a recording in which the lines of frames are missing."""
    if source.is_dir():
        from app.recording.reader import Recording

        if lost := Recording(source).lost_lines:
            print_warning(lost)


def remind(sentence: str) -> None:
    """Print what a person must not forget."""
    sys.stderr.write(f"{sentence}\n")


def ask(request: str) -> None:
    """Ask a person to do something at the bench, and wait for Enter; `InputError` without terminal."""
    if not sys.stdin.isatty():
        raise InputError(f"this bench has no motors: run the command in a terminal, to be asked to {request}")
    remind(f"{request}, then press Enter")
    if not sys.stdin.readline():
        raise InputError(f"the terminal was closed before this was done: {request}")


def confirm_libraries(bench: Bench, *, is_trusted: bool) -> None:
    """Ask, or if `is_trusted` remember, whether each library of a bench may be loaded; `InputError` if not."""
    from app.bench.trusted_libraries import trust, unconfirmed

    for library in unconfirmed(bench):
        setting = f"{library.key} = {library.named}"
        if not is_trusted:
            if not sys.stdin.isatty():
                raise InputError(
                    f"{setting} would run code: add --trust-library once if you trust it, or start the command in a"
                    " terminal to be asked"
                )
            sys.stderr.write(f"the bench runs code: {setting}\nType yes if you trust it: ")
            if sys.stdin.readline().strip().lower() != "yes":
                raise InputError(f"{setting} is not trusted: change the bench")
        trust([library])
