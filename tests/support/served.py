"""An instrument that serves clients from a thread of the tests, with fake devices, and its connections."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from app.acquisition.address import NAME, is_taken, taken_address
from app.acquisition.remote.connection import Connection, reach
from app.acquisition.remote.server import Server
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.measurement.measurement import Measurement
from drivers.interface import Disconnected
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import wait_until


@contextmanager
def served(
    camera: FakeCamera,
    *,
    begin: Callable[[Acquisition], object] = lambda to: start_up(to, 3),
    faults: list[Exception] | None = None,
) -> Iterator[Server]:
    """Serve a fake camera until the end of the block; `faults` that are expected get what ended it."""
    servers: list[Server] = []

    def work() -> None:
        with taken_address() as address:
            servers.append(Server(BENCH, address, opener(camera)))
            try:
                servers[0].run(begin)
            except Disconnected:  # of the fake camera; tests look at it
                pass
            except Exception as error:
                if faults is None:
                    raise
                faults.append(error)

    thread = threading.Thread(target=work, name="served")
    thread.start()
    wait_until(lambda: is_taken(NAME))
    try:
        yield servers[0]
    finally:
        servers[0].end()
        thread.join()


@contextmanager
def connected(what: str = "test", *, takes_control: bool = True) -> Iterator[Connection]:
    """Connect to the served instrument."""
    connection = reach(what, takes_control=takes_control)
    try:
        yield connection
    finally:
        connection.close()


def newest(connection: Connection, holds: Callable[[Measurement], object] = lambda made: made.wavefront) -> Measurement:
    """Return the newest measurement, once it holds what is wanted."""
    wait_until(lambda: connection.newest is not None and holds(connection.newest))
    assert connection.newest is not None
    return connection.newest
