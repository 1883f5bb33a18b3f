"""What is connected: `svwfs devices`."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli.options import SetOption, load
from app.errors import InputError


def devices(
    *,
    check: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Try everything that a device must be able to do on this one, by its name in the list, and print a"
            " report. A light shines for it, with at most a twentieth of its range.",
        ),
    ] = None,
    bench: Annotated[
        str | None,
        typer.Option(
            "--bench",
            "-b",
            metavar="TOML",
            help="With --check camera or --check light: that of this bench, as it says.",
        ),
    ] = None,
    setting: SetOption = None,
) -> None:
    """Say which cameras and lights are connected, how a bench names them, and what is missing to use them.

    Looking switches nothing on. docs/hardware.md says how to connect each.
    """
    from app.commands.devices import check_and_print, print_devices

    if check is None and bench is None:
        print_devices()
    elif check is None:
        raise InputError("--bench goes with --check camera or --check light")
    else:
        check_and_print(check, None if bench is None else load(bench, setting))
