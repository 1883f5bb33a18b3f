"""The commands of `svwfs`.

Each is imported when it is named, and imports what it needs when it runs, so that `--help` is fast.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command_from_info
from typer.models import CommandInfo

import app.commands

# In the order of the help. `light-off` is the function `light_off` in app/commands/light_off.py; the first line of its
# docstring is what the list of all commands says.
_NAMES = (
    *("live", "measure", "serve", "recover", "replay", "batch"),
    *("export", "report", "compare", "layers", "corrector", "field", "deconvolve"),
    *("calibrate", "simulate", "mask", "devices", "light-off", "schema", "docs", "desktop"),
    *("selftest", "paper", "benchmark", "reconstruct"),
)


class _NotImported(TyperCommand):
    """A command of which only the name and a line of help are known."""

    def imported(self) -> Any:
        """Import the command."""
        from app.commands.options import OnceCommand

        name = str(self.name).replace("-", "_")
        function = getattr(import_module(f"app.commands.{name}"), name)
        info = CommandInfo(self.name, cls=OnceCommand, callback=function)
        return get_command_from_info(info, pretty_exceptions_short=False, rich_markup_mode=None)

    def get_short_help_str(self, limit: int = 45) -> str:
        """Read the first line of the docstring."""
        name = str(self.name).replace("-", "_")
        source = Path(app.commands.__path__[0], f"{name}.py").read_text("utf-8")
        found = re.search(rf'^def {name}\(.*?^    """(.*?)$', source, re.DOTALL | re.MULTILINE)
        self.help = found and found[1].removesuffix('"""')
        return super().get_short_help_str(limit)


class _Commands(TyperGroup):
    """The group of all commands; it imports those that are used."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.commands = {name: _NotImported(name=name) for name in _NAMES} | dict(self.commands)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return the name, the command and the other arguments."""
        name, command, others = super().resolve_command(ctx, args)
        return name, command.imported() if isinstance(command, _NotImported) else command, others


cli = typer.Typer(
    cls=_Commands,
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
