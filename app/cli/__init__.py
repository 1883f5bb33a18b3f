"""The command `svwfs`: what can be asked of the instrument from a shell.

Each command loads what it needs when it runs, so that help comes at once.
"""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli.exit_status import run_and_leave
from app.cli.frames import calibrate, reconstruct, simulate
from app.cli.hardware import devices
from app.cli.measuring import live, measure
from app.cli.paper_tables import paper
from app.cli.recordings import export, recover, replay, report
from app.cli.studies import benchmark, selftest, study

cli = typer.Typer(
    help="Space-variant Shack-Hartmann wavefront sensing, live: the wavefront at every position of the field.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@cli.callback(invoke_without_command=True)
def _common(
    show_version: Annotated[bool, typer.Option("--version", help="Show the version and leave.")] = False,
) -> None:
    if show_version:
        from importlib.metadata import version

        typer.echo(f"svwfs {version('svwfs')}")
        raise typer.Exit


_COMMANDS = (  # in the order of the help
    live,
    measure,
    recover,
    replay,
    export,
    report,
    calibrate,
    simulate,
    devices,
    selftest,
    study,
    benchmark,
    reconstruct,
)
for command in _COMMANDS:
    cli.command()(command)
cli.add_typer(paper, name="paper")


def main() -> None:
    """Run the command line and leave with its exit status."""
    run_and_leave(cli)
