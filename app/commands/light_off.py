"""`svwfs light-off`: the light of a bench, switched off whatever happened before."""

from __future__ import annotations

from typing import Annotated

import typer

from app.commands import options, terminal


def light_off(bench: Annotated[str, options.bench_option("Bench TOML file.")]) -> None:
    """Switch the light of a bench off, for example after a service was killed.

    It fails if another program has the light open. A systemd service can have it as ExecStopPost.

    Example: svwfs light-off --bench lab.toml
    """
    from app.acquisition.devices import open_light
    from app.errors import InputError, RunError
    from drivers.errors import BadValue

    loaded = options.load(bench, None)
    if loaded.is_simulated:
        typer.echo("the light of this bench is simulated: there is nothing to switch off")
        return
    if loaded.has_manual_light:
        raise RunError("the light of this bench is manual: switch it off by hand")
    try:
        with open_light(loaded.light) as opened:
            name = opened.name
    except BadValue as error:
        raise InputError(f"light: {error}") from error
    terminal.print_sentence(f"{name} is off")
