"""The instrument's end of the wire: strangers, clients that do not read, faults, and a full ring."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq
from support.gui_bench import FakeCamera
from support.patience import HANG_S, wait_until
from support.served import connected, newest, served

from app.acquisition.address import file_of
from app.acquisition.remote.messages import Answer, Bye, Command, Hello, State
from app.acquisition.remote.server import Server
from app.acquisition.serialization import encoded, unpacked

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("runtime_folder")]  # each prepares a reference


def text_message(text: str) -> bytes:
    return len(text).to_bytes(8, "little") + bytes(56) + text.encode()


def test_strangers_are_not_heard(server: Server) -> None:
    with connected(takes_control=False) as watching, zmq.Context() as context:
        wait_until(lambda: server.acquisition.status is not None)
        messages: list[list[bytes | bytearray]] = [
            [b"wrong key", encoded(Hello("stranger", True, 0.0))],
            [server.address.key.encode(), b"no message"],
            [server.address.key.encode(), text_message('[{"of":[]},[]]')],
            [server.address.key.encode(), text_message("[" + '{"tuple":[' * 5000 + "]}" * 5000 + ",[]]")],
            [server.address.key.encode()],
            [b""],
            [server.address.key.encode(), encoded(Command(1, "shut_down"))],  # without a hello
            [server.address.key.encode(), encoded(Hello("no number", True, "abc"))],  # type: ignore[arg-type] # wrong
            [server.address.key.encode(), encoded(Hello("no time", True, math.nan))],
            [server.address.key.encode(), encoded(Hello([1], True, 0.0))],  # type: ignore[arg-type] # no name
            [server.address.key.encode(), encoded(Bye()), b"more"],
        ]
        with context.socket(zmq.DEALER) as socket:
            socket.connect(server.address.endpoint)
            for parts in messages:
                socket.send_multipart(parts)
            say(socket, server, Hello("known", False, 0.0))  # heard after the others
            wait_until(lambda: "known" in watching.clients)
            assert set(watching.clients) == {watching.name, "known"}
        assert watching.is_alive
        assert not watching.controller


@contextmanager
def silent_client(server: Server) -> Iterator[zmq.Socket[bytes]]:
    """A client that has said hello, and reads no more."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.RCVHWM, 1)
        socket.connect(server.address.endpoint)
        say(socket, server, Hello("silent", True, 0.0))
        wait_until(lambda: server._clients)
        yield socket


def say(socket: zmq.Socket[bytes], server: Server, message: object) -> None:
    socket.send_multipart([server.address.key.encode(), encoded(message)])


def send_news(server: Server, count: int) -> None:
    """Let the server tell of so many states, one after the other."""
    for _ in range(count):
        server._frames.count += 1
        server._hurry()
        while server._state_due_s < 0:
            time.sleep(0.0005)


def read_all(socket: zmq.Socket[bytes]) -> Iterator[object]:
    """Yield the messages that have arrived."""
    until_s = time.monotonic() + HANG_S
    while socket.poll(500):
        assert time.monotonic() < until_s, "news does not end"
        yield unpacked(socket.recv())


def test_an_answer_reaches_a_client_that_did_not_read_for_long(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    wait_until(lambda: server.acquisition.status is not None)
    monkeypatch.setattr("app.acquisition.remote.server._SILENT_S", 60.0)
    with silent_client(server) as socket:
        send_news(server, 2000)  # more than the system keeps by itself
        say(socket, server, Command(7, "free_minutes", (Path.cwd(),)))
        assert next(each.number for each in read_all(socket) if isinstance(each, Answer)) == 7


def test_a_client_that_falls_silent_gets_no_news_until_it_says_hello(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_until(lambda: server.acquisition.status is not None)
    monkeypatch.setattr("app.acquisition.remote.server._SILENT_S", 0.1)
    with silent_client(server) as socket:
        wait_until(lambda: not server._clients)
        assert list(read_all(socket))
        send_news(server, 20)
        assert not list(read_all(socket))
        say(socket, server, Hello("silent", False, 0.0))
        assert next(each.count for each in read_all(socket) if isinstance(each, State)) >= 20


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # the worker ends loudly
def test_a_fault_of_the_instruments_end_switches_the_light_off_and_is_told(
    fake_camera: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = list[Exception]()

    def fail(*_: object, **__: object) -> None:
        raise OSError("no memory is left")

    with served(fake_camera, faults=faults) as server, connected() as connection:
        newest(connection)
        monkeypatch.setattr(server, "_answer", fail)
        connection.take_control()
        wait_until(lambda: not connection.is_alive)
        assert connection.failure == "OSError: no memory is left"
        wait_until(lambda: faults)
        assert not server.acquisition.is_alive
        assert not fake_camera.light.shines
    assert str(faults[0]) == "no memory is left"


def test_log_of_a_library_that_prints_at_every_frame_stays_small(server: Server) -> None:
    with file_of(server.address.name, "log").open("ab") as log:
        for line in (b"a frame\n" * 200_000, b"a crash\n"):
            log.write(line)
            log.flush()
            wait_until(lambda: Path(log.name).stat().st_size < 1000)
    assert Path(log.name).read_bytes() == b"a crash\n"
