"""`svwfs devices`: list the connected devices, or check one of them."""

from typing import Annotated

import typer

from app.commands import options, terminal
from app.errors import InputError


def devices(
    *,
    check: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Test everything that this device, named as in the list, must be able to do, and print a report that"
            " can be published: versions, what was tried, what failed, timings. A light shines during the test,"
            " with at most 5 % of its range.",
        ),
    ] = None,
    bench: Annotated[
        str | None,
        options.bench_option("With --check camera or --check light: that device of this bench, with its settings."),
    ] = None,
    trust_library: options.Trust = False,
    serial_numbers: Annotated[
        bool, typer.Option("--serial-numbers", help="Show serial numbers in the report of --check.")
    ] = False,
    setting: options.Set = None,
) -> None:
    """List the connected cameras and lights.

    Each is shown with its section of a bench file and with what is missing to use it. Listing switches nothing on. See
    `svwfs docs own_sensor` for how to connect each. The devices of the presets are simulated: check your own bench.

    Example: svwfs devices

    Example: svwfs devices --check light --bench bench.toml
    """
    from app.commands.device_check import check_and_print

    if check is None and bench is None:
        print_devices()
    elif check is None:
        raise InputError("--bench needs --check camera or --check light")
    else:
        loaded = None if bench is None else options.load(bench, setting)
        if loaded is not None:
            terminal.confirm_libraries(loaded, is_trusted=trust_library)
        check_and_print(check, loaded, serial_numbers=serial_numbers)


def print_devices() -> None:
    """Search for all supported devices, and print the result."""
    import tomli_w
    from rich.console import Console

    from app.bench.device_kinds import KINDS

    console = Console(soft_wrap=True, highlight=False)
    for kind in KINDS:
        devices, missing = kind.discover()
        console.print(f"[bold]{kind.heading}[/bold]")
        if missing:
            console.print(f"  not searched: {missing}", markup=False)
        elif not devices:
            console.print("  none found")
        for device in devices:
            doubt = "" if device.is_certain else "perhaps a "
            console.print(f"  {device.name}   {doubt}{device.description}", markup=False)
            if device.missing:
                console.print(f"    cannot be used yet: {device.missing}", markup=False)
            section = tomli_w.dumps({device.kind: {"driver": device.driver, **device.settings}})
            for line in section.splitlines():
                console.print(f"      {line}", markup=False)
