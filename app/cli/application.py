"""The commands of `svwfs`.

Each command imports what it needs when it runs, so that `--help` is fast.
"""

from importlib import import_module
from typing import Annotated, Any

import typer
from typer.main import get_command_from_info
from typer.models import CommandInfo

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


_ANALYSES = {  # commands whose files are loaded when they run, with the first sentence of their help
    "export": "Convert a recording for other programs.",
    "report": "Summarise a recording on three pages.",
    "layers": "Find at which distance the aberration originates.",
    "corrector": "Tell what one corrector could do, over its distance.",
    "field": "Map the coefficients of a wavefront over the field, with errors.",
    "deconvolve": "Deconvolve an image by the measured aberration of each field position.",
}


class _LazyCommand(OnceCommand):
    """Command whose file is loaded when more than its first sentence is needed."""

    def __init__(self, **known: Any) -> None:
        super().__init__(**known)
        del self.params, self.callback

    def __getattr__(self, name: str) -> Any:
        if name not in {"params", "callback"}:
            raise AttributeError(name)
        function = getattr(import_module(f"app.commands.{self.name}"), str(self.name))
        made = get_command_from_info(
            CommandInfo(callback=function), pretty_exceptions_short=False, rich_markup_mode=None
        )
        self.params, self.callback, self.help = made.params, made.callback, made.help
        return getattr(made, name)


# in the order of the help
for command in (live, measure, serve, recover, replay, batch):
    cli.command(cls=OnceCommand)(command)
for name, sentence in _ANALYSES.items():
    cli.command(name, cls=_LazyCommand, help=sentence)(lambda: None)
for other in (calibrate, simulate, mask, devices, light_off, desktop, selftest, study, paper, benchmark, reconstruct):
    cli.command(cls=OnceCommand)(other)
