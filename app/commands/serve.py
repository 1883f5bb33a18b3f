"""`svwfs serve`: the instrument without a window, to which windows and programs attach."""

from __future__ import annotations

import faulthandler
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.acquisition.address import NAME, taken_address
from app.cache import loading
from app.commands import options, terminal
from app.errors import Interrupted
from app.measurement.routines import Cancelled

if TYPE_CHECKING:
    from concurrent.futures import Future

    from app.acquisition.worker import Acquisition


def serve(
    *,
    bench: options.Bench,
    name: Annotated[str, typer.Option(metavar="NAME", help="Name by which clients find it.")] = NAME,
    idle: Annotated[
        bool, typer.Option("--idle", help="Open the devices only: dark, reference and camera wait for a client.")
    ] = False,
    trust_library: options.Trust = False,
    setting: options.Set = None,
) -> None:
    """Run an instrument without a window; windows, notebooks and commands attach to it.

    It takes dark and reference, moves the sample in, and measures until Ctrl-C, or until a client shuts it down; then
    the light is off. svwfs live --attach, svwfs measure --attach and svwfs.connect() attach to it; a client that hangs
    or is killed changes nothing. See `svwfs docs sharing`.

    Example: svwfs serve --bench live_demo

    Example: svwfs serve --bench lab.toml --name left
    """
    with loading():
        from app.acquisition.remote.server import Server
        from app.acquisition.start_up import start_up

    def begin(acquisition: Acquisition) -> None:
        def tell(step: Future[Any]) -> None:
            error = step.exception()
            ends = acquisition.error is not None or acquisition.is_closing  # the command says why
            if error is not None and not ends and not isinstance(error, Cancelled):
                terminal.print_warning(str(error))

        for step in () if idle else start_up(acquisition):
            step.add_done_callback(tell)

    if not faulthandler.is_enabled():
        faulthandler.enable()  # a crash, as in a vendor's library, says where
    loaded = options.load(bench, setting)
    terminal.confirm_libraries(loaded, is_trusted=trust_library)
    with taken_address(name) as address:
        server = Server(loaded, address)
        which = "" if name == NAME else f" --name {name}"
        terminal.print_sentence(
            f"the instrument runs as process {address.process}; attach with svwfs live --attach{which}; Ctrl-C ends it"
        )
        try:
            server.run(begin)
        except Interrupted as error:
            if loaded.has_manual_light:
                raise
            raise Interrupted("interrupted: the light is off") from error
        finally:
            if loaded.has_manual_light:
                terminal.remind(terminal.LIGHT_BY_HAND)
