"""A command of `svwfs` that refuses a repeated option, and a folder's name for a file."""

from collections import Counter
from pathlib import Path
from typing import Any

from typer.core import TyperCommand, TyperOption

FOLDER = "FOLDER"  # in the help, of an option that names a folder


class Command(TyperCommand):
    """Command whose options are given once."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; a repeated option would else replace itself, and a final slash be ignored."""
        values, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for option, count in Counter(order).items():
            if not isinstance(option, TyperOption) or option.multiple or option.is_flag:
                continue
            if count > 1:
                ctx.fail(f"{option.opts[0]} is given {count} times: give it once")
            value = str(values.get(option.name))
            if value.endswith("/") and option.metavar != FOLDER and not Path(value).is_dir():
                ctx.fail(f"{option.opts[0]} {value}: no such folder; leave the slash out of a file's name")
        return super().parse_args(ctx, args)
