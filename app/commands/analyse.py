"""The commands of analyses: each has the options of its file, and the same work around it."""

from __future__ import annotations

from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.main import get_command_from_info
from typer.models import CommandInfo

from app.commands import options, terminal
from app.errors import InputError, Interrupted
from app.files import require_suffix
from app.results.analysis import load_analysis

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
        info = CommandInfo(callback=command_of(load_analysis(str(self.name))))
        made = get_command_from_info(info, pretty_exceptions_short=False, rich_markup_mode=None)
        self.params, self.callback, self.help = made.params, made.callback, made.help
        return getattr(made, name)


def command_of(kind: type[Analysis]) -> Callable[..., None]:
    """Return a function with the options of an analysis, which computes, writes, draws and prints it."""

    def run(source: Path, out: Path, plot: Path | None = None, *, overwrite: bool, **chosen: Any) -> None:
        from reconstruction.errors import ReconstructionError

        analysis = kind(**chosen)
        reads, writes = analysis.more_files(source)
        sources = analysis.sources(source)
        allowed = () if kind.needs_suffix else analysis.suffixes
        options.check_files(
            out, *writes, reads=reads, sources=sources, suffixes=allowed, plot=plot, overwrite=overwrite
        )
        if kind.needs_suffix:
            require_suffix(out, *analysis.suffixes)
        try:
            with terminal.progress_bar() as progress:
                found = analysis.run(source, out, progress)
                options.draw(plot, lambda: analysis.draw(found), dpi=kind.picture_dpi)
        except ReconstructionError as error:
            raise InputError(f"{source}: {error}") from error
        except Interrupted:
            raise Interrupted(f"interrupted: {out} is not written") from None
        if (table := analysis.by_view(found)) is not None:
            terminal.print_by_view(*table)
        typer.echo("\n".join(analysis.sentences(found)) + kind.closing.format(out=out))
        for each in sources:
            terminal.print_missing_lines(each)

    own = [each.replace(kind=each.KEYWORD_ONLY) for each in signature(kind, eval_str=True).parameters.values()]
    needed = [each for each in own if each.default is each.empty]
    others = [each for each in own if each not in needed]
    out = Annotated[Path, typer.Option(help=kind.file_help)]
    files = [_parameter("source", kind.source), _parameter("out", out)]
    plot = [_parameter("plot", options.Plot, None)] if kind.picture_dpi else []
    overwrite = _parameter("overwrite", options.Overwrite, False)
    run.__signature__ = Signature([*needed, *files, *others, *plot, overwrite])  # type: ignore[attr-defined] # for typer
    run.__doc__ = kind.__doc__
    return run


def _parameter(name: str, annotation: Any, default: Any = Parameter.empty) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=annotation, default=default)
