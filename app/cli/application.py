"""The commands of `svwfs`.

Each command imports what it needs when it runs, so that `--help` is fast.
"""

from typing import Annotated

import typer

from app.commands.analyse import AnalysisCommand
from app.commands.batch import batch
from app.commands.benchmark import benchmark
from app.commands.calibrate import calibrate
from app.commands.desktop import desktop
from app.commands.devices import devices
from app.commands.light_off import light_off
from app.commands.live import live
from app.commands.mask import mask
from app.commands.measure import measure
from app.commands.options import OnceCommand
from app.commands.paper import paper
from app.commands.reconstruct import reconstruct
from app.commands.recover import recover
from app.commands.replay import replay
from app.commands.selftest import selftest
from app.commands.serve import serve
from app.commands.simulate import simulate
from app.commands.study import study
from app.results.analysis import ANALYSES

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
for command in (live, measure, serve, recover, replay, batch):
    cli.command(cls=OnceCommand)(command)
for name, (_, sentence) in ANALYSES.items():
    cli.command(name, cls=AnalysisCommand, help=sentence)(lambda: None)
for other in (calibrate, simulate, mask, devices, light_off, desktop, selftest, study, paper, benchmark, reconstruct):
    cli.command(cls=OnceCommand)(other)
