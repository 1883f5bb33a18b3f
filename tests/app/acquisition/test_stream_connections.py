"""Connections to the streams: who is warned of, how many there may be, and what floods do to the others."""

from __future__ import annotations

import socket
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import zmq
from support.patience import wait_until
from support.streams import Subscriber, until_heard

from app.acquisition.streams.guard import CONNECTIONS, TOPIC_BYTES
from app.acquisition.streams.publisher import Publisher, stream_sinks
from app.bench.config import Bench, StreamSettings
from app.errors import RunError
from app.measurement.measurement import Measurement


def test_without_port_no_socket_is_opened(stream_bench: Bench, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zmq, "Context", lambda: pytest.fail("a socket was made"))
    with stream_sinks(stream_bench) as sinks:
        assert sinks == ()
    monkeypatch.undo()
    with stream_sinks(replace(stream_bench, streams=StreamSettings(port=port))) as sinks:
        assert len(sinks) == 1
        listening = _listening(port)
    assert listening == ["127.0.0.1"]


def _listening(port: int) -> list[str]:
    """Addresses on which a port is open, from the kernel's table."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    local = [row[1].split(":") for row in rows if row[3] == "0A"]
    return [socket.inet_ntoa(bytes.fromhex(host)[::-1]) for host, at in local if int(at, 16) == port]


def test_taken_port_is_one_sentence(stream_bench: Bench, port: int) -> None:
    streams = StreamSettings(port=port)
    with (
        stream_sinks(replace(stream_bench, streams=streams)),
        pytest.raises(RunError, match=rf"127.0.0.1:{port}: Address already in use; change streams.port"),
        stream_sinks(replace(stream_bench, streams=streams)),
    ):
        pass


def test_foreign_address_is_one_sentence(stream_bench: Bench, port: int) -> None:
    elsewhere = replace(stream_bench, streams=StreamSettings(port=port, address="192.0.2.1"))
    with pytest.raises(RunError, match="assign"), stream_sinks(elsewhere):
        pass


def descriptors() -> int:
    """Number of open files and sockets of this process."""
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def test_connections_are_limited(publisher: Publisher, port: int, measurement: Measurement) -> None:
    before, ours = descriptors(), list[socket.socket]()
    for _ in range(400):
        ours.append(socket.create_connection(("127.0.0.1", port)))
        wait_until(lambda: descriptors() - before - len(ours) <= CONNECTIONS + 10)  # some are about to be closed
    wait_until(lambda: descriptors() - before - len(ours) <= CONNECTIONS)
    for connection in ours:
        connection.close()
    with closing(Subscriber(port, "views")) as subscriber:  # there is room again
        until_heard(publisher, subscriber, measurement)


def test_long_topic_closes_its_connection(publisher: Publisher, port: int, measurement: Measurement) -> None:
    with closing(Subscriber(port, "views")) as subscriber, closing(Subscriber(port, "v" * 10_000)) as other:
        until_heard(publisher, subscriber, measurement)
        assert max(map(len, publisher._subscriptions)) < 10_000
        assert other.is_waiting()


def test_flood_of_subscriptions_closes_its_connection(
    publisher: Publisher, port: int, measurement: Measurement
) -> None:
    with closing(Subscriber(port, "views")) as subscriber:
        until_heard(publisher, subscriber, measurement)
        with closing(Subscriber(port)) as flooding:
            for number in range(20_000):
                flooding._socket.subscribe(str(number).ljust(TOPIC_BYTES, "x"))
            wait_until(lambda: publisher._guard._addresses["127.0.0.1"].open_from_s > 0)  # the flood was noticed
            wait_until(lambda: publisher._subscriptions == {b"views"})  # and its connection closed
            until_heard(publisher, subscriber, measurement)  # the other one stays connected


@pytest.mark.parametrize(("address", "is_warned"), [("127.0.0.1", False), ("127.8.9.1", False), ("0.0.0.0", True)])  # noqa: S104 - it is warned of
def test_open_address_is_warned_of(
    stream_bench: Bench, port: int, capsys: pytest.CaptureFixture[str], address: str, is_warned: bool
) -> None:
    with stream_sinks(replace(stream_bench, streams=StreamSettings(port=port, address=address))):
        pass
    errors = capsys.readouterr().err
    assert errors.startswith("warning: every computer that reaches 0.0.0.0 can read the results") == is_warned
    assert bool(errors) == is_warned
