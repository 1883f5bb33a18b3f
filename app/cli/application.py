"""The commands of `svwfs`.

Each command imports what it needs when it runs, so that `--help` is fast.
"""

from typing import Annotated

import typer

from app.cli.answers import corrector, field, layers
from app.cli.command import Command
from app.cli.evaluation import benchmark, paper, selftest, study
from app.cli.frames import calibrate, deconvolve, reconstruct, simulate
from app.cli.measuring import desktop, devices, live, measure
from app.cli.recordings import batch, export, recover, replay, report

cli = typer.Typer(
    help="Live space-variant Shack-Hartmann wavefront sensing: the wavefront at every position of the field.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # rich takes 0.1 s to import, and breaks the lines of paragraphs
    context_settings={"help_option_names": ["-h", "--help"]},
)


@cli.callback(invoke_without_command=True)
def _common(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if show_version:
        from importlib.metadata import version

        typer.echo(f"svwfs {version('svwfs')}")
        raise typer.Exit


# in the order of the help
_BENCH = (live, measure, recover, replay, batch, export, report)
_ANSWERS = (layers, corrector, field)
_OTHERS = (calibrate, simulate, devices, desktop, selftest, study, benchmark, reconstruct, deconvolve)
for command in (*_BENCH, *_ANSWERS, *_OTHERS):
    cli.command(cls=Command)(command)
cli.add_typer(paper, name="paper")
