"""Limits on what other programs send to the publisher's port, so that they cannot exhaust this one.

A ZeroMQ socket accepts any number of connections, each with a file descriptor, and while changes of subscriptions
arrive it does nothing else. So a thread watches the connections from outside, and counts what they send.
"""

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import zmq
from zmq.utils.monitor import recv_monitor_message

CONNECTIONS = 32
TOPIC_BYTES = 54  # longest topic; the connection of a longer one is closed
_COMMAND_BYTES = 10  # of a message, before its topic
BURST_BYTES = 20_000  # from one address at once: a thousand changes of subscriptions, or 40 connections
_BYTES_PER_S = 2_000  # from one address
_TOGETHER = 4  # times as much from all addresses
_CONNECTION_BYTES = 500  # counted for each connection; to subscribe to all topics takes 200
_PAUSE_S = 5.0  # without new connections from an address that sent too much
_POLL_MS = 20
_READ_AHEAD = 100  # changes of one connection that ZeroMQ takes before they are read
_READ_AHEAD_BYTES = 4096  # that the system takes
_HANDSHAKE_MS = 2000
_MOST_ADDRESSES = 1000  # remembered
_BYTES_RECEIVED = 128  # offset in Linux's struct tcp_info


def limit(publishing: zmq.Socket[bytes]) -> None:
    """Set the limits that ZeroMQ knows, before the port is opened."""
    publishing.setsockopt(zmq.MAXMSGSIZE, _COMMAND_BYTES + TOPIC_BYTES)
    publishing.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
    publishing.setsockopt(zmq.RCVHWM, _READ_AHEAD)
    publishing.setsockopt(zmq.RCVBUF, _READ_AHEAD_BYTES)


class _Allowance:
    """Bytes that may still be received; it refills."""

    def __init__(self, times: int = 1) -> None:
        self._times, self._left, self._at_s = times, float(times * BURST_BYTES), time.monotonic()
        self.open_from_s = 0.0  # no new connections before

    def spend(self, count: int) -> bool:
        """True if so many bytes are allowed; pauses otherwise."""
        now_s = time.monotonic()
        refilled = self._left + self._times * _BYTES_PER_S * (now_s - self._at_s)
        left = min(refilled, self._times * BURST_BYTES) - count
        self._left, self._at_s = max(left, 0.0), now_s
        if left < 0:
            self.open_from_s = now_s + _PAUSE_S
        return left >= 0


class ConnectionGuard:
    """Closes connections beyond the limits, in its own thread."""

    def __init__(self, publishing: zmq.Socket[bytes], port: int) -> None:
        events = zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | zmq.EVENT_MONITOR_STOPPED
        self._monitor = publishing.get_monitor_socket(events)
        self._port = port
        self._received: dict[int, int] = {}  # bytes of each connection, a file descriptor
        self._together, self._addresses = _Allowance(_TOGETHER), dict[str, _Allowance]()
        self._thread = threading.Thread(target=self._watch, name="connection guard", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait for the end of the thread, after the publishing socket's monitor has ended."""
        self._thread.join()
        self._monitor.close()

    def _watch(self) -> None:
        while True:
            if self._monitor.poll(_POLL_MS if self._received else None):
                event = recv_monitor_message(self._monitor)
                if event["event"] == zmq.EVENT_MONITOR_STOPPED:
                    return
                if event["event"] == zmq.EVENT_DISCONNECTED:
                    self._received.pop(int(event["value"]), None)
                else:
                    with suppress(OSError):
                        self._welcome(int(event["value"]))
            for descriptor in list(self._received):
                try:
                    self._count(descriptor)
                except OSError:
                    self._received.pop(descriptor, None)

    def _welcome(self, descriptor: int) -> None:
        """Take note of a new connection, or close it."""
        self._received.pop(descriptor, None)
        with self._connection(descriptor) as connection:
            limits = self._limits(connection)
            if len(self._received) >= CONNECTIONS or time.monotonic() < max(each.open_from_s for each in limits):
                connection.shutdown(socket.SHUT_RDWR)
                return
            self._received[descriptor] = 0
        self._spend(descriptor, _CONNECTION_BYTES)

    def _count(self, descriptor: int) -> None:
        """Count what a connection has sent since the last time, where the system tells."""
        if hasattr(socket, "TCP_INFO"):
            with self._connection(descriptor) as connection:
                size = _BYTES_RECEIVED + 8
                info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, size).ljust(size, b"\0")
                (received,) = struct.unpack_from("=Q", info, _BYTES_RECEIVED)
                more, self._received[descriptor] = received - self._received[descriptor], received
                if more > 0:
                    self._spend(descriptor, more)

    def _spend(self, descriptor: int, count: int) -> None:
        """Count bytes; close the connection if they are too many."""
        with self._connection(descriptor) as connection:
            are_allowed = [each.spend(count) for each in self._limits(connection)]
            if not all(are_allowed):
                self._received.pop(descriptor, None)
                connection.shutdown(socket.SHUT_RDWR)  # ZeroMQ closes it then

    def _limits(self, connection: socket.socket) -> tuple[_Allowance, _Allowance]:
        if len(self._addresses) > _MOST_ADDRESSES:
            self._addresses.clear()
        return self._together, self._addresses.setdefault(connection.getpeername()[0], _Allowance())

    @contextmanager
    def _connection(self, descriptor: int) -> Iterator[socket.socket]:
        """A connection; OSError if it has gone. Another file may have its number by then, and is left alone."""
        connection = socket.socket(fileno=descriptor)
        try:
            if connection.getsockname()[1:2] != (self._port,):
                raise ConnectionError
            yield connection
        finally:
            connection.detach()
