"""The commands of analyses: each has the options of its file, and the same work around it."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from typer.main import get_command_from_info
from typer.models import CommandInfo

from app.commands import options, terminal
from app.errors import InputError, Interrupted
from app.files import require_suffix
from app.results.analysis import load

if TYPE_CHECKING:
    from collections.abc import Callable

    from app.results.analysis import Analysis


class AnalysisCommand(options.OnceCommand):
    """Command whose file is read when more than its first sentence is needed."""

    def __init__(self, **known: Any) -> None:
        super().__init__(**known)
        del self.params, self.callback

    def __getattr__(self, name: str) -> Any:
        if name not in {"params", "callback"}:
            raise AttributeError(name)
        info = CommandInfo(callback=command_of(load(str(self.name))))
        made = get_command_from_info(info, pretty_exceptions_short=False, rich_markup_mode=None)
        self.params, self.callback, self.help = made.params, made.callback, made.help
        return getattr(made, name)


def command_of(kind: type[Analysis]) -> Callable[..., None]:
    """Return a function with the options of an analysis, which computes, writes, draws and tells it."""

    def run(source: Path, out: Path, plot: Path | None = None, *, overwrite: bool, **chosen: Any) -> None:
        from app.progress import between
        from reconstruction.errors import ReconstructionError

        analysis = kind(**chosen)
        reads, writes = analysis.more_files(source)
        reads = [*options.files_of_sources(source), *reads]
        suffixes = () if kind.needs_suffix else kind.suffixes
        options.check_files(out, *suffixes, reads=reads, plot=plot, more=writes, overwrite=overwrite)
        if kind.needs_suffix:
            require_suffix(out, *kind.suffixes)
        try:
            with terminal.progress_bar() as progress:
                bench, found = analysis.compute(source, between(progress, 0.0, 0.9))
                progress("writing", 0.9)
                analysis.write(found, bench, source, out)
                if plot is not None:
                    from app.results.figures import save_figure

                    save_figure(analysis.draw(found), plot, dpi=kind.picture_dpi)
        except ReconstructionError as error:
            raise InputError(f"{source}: {error}") from error
        except Interrupted:
            raise Interrupted(f"interrupted: {out} is not written") from None
        typer.echo("\n".join(analysis.sentences(found)) + kind.closing.format(out=out))
        terminal.print_version_notice(source)

    own = {field.name: field.default for field in dataclasses.fields(kind)}  # type: ignore[arg-type] # it is one
    needed = [name for name, default in own.items() if default is dataclasses.MISSING]
    defaults = {name: default for name, default in own.items() if name not in needed}
    defaults |= ({"plot": None} if kind.picture_dpi else {}) | {"overwrite": False}
    hints = get_type_hints(kind, include_extras=True)
    hints |= {"source": kind.source, "out": Annotated[Path, typer.Option(help=kind.file_help)]}
    hints |= {"plot": options.Plot, "overwrite": options.Overwrite}
    run.__annotations__ = {name: hints[name] for name in (*needed, "source", "out", *defaults)}
    run.__signature__ = inspect.Signature(  # type: ignore[attr-defined] # typer reads it
        [
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                annotation=hint,
                default=defaults.get(name, inspect.Parameter.empty),
            )
            for name, hint in run.__annotations__.items()
        ]
    )
    run.__doc__ = kind.__doc__
    return run
