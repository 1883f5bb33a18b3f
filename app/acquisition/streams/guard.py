"""Limits on the connections of the publisher's port, so that no other program can exhaust this one.

A ZeroMQ socket accepts any number of connections, each with a file descriptor, and keeps every change of subscriptions
until it is read. A recording would end when descriptors or memory do.
"""

import socket
import time
from collections import Counter
from contextlib import suppress

import zmq
from zmq.utils.monitor import recv_monitor_message

CONNECTIONS = 32
CHANGES = 1000  # of subscriptions, per connection; ten would do
TOPIC_BYTES = 1024  # longest message from a subscriber; its connection is closed beyond
_HANDSHAKE_MS = 2000
_PAUSE_S = 5.0  # without new connections after a flood of changes


def limit(publishing: zmq.Socket[bytes]) -> None:
    """Set the limits that ZeroMQ knows, before the port is opened."""
    publishing.setsockopt(zmq.MAXMSGSIZE, TOPIC_BYTES)
    publishing.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)


class ConnectionGuard:
    """Closes connections beyond the limits; used by one thread."""

    def __init__(self, publishing: zmq.Socket[bytes], port: int) -> None:
        self.monitor = publishing.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        self._port = port
        self._connected: set[int] = set()  # file descriptors
        self._changes: Counter[int] = Counter()
        self._open_from_s = 0.0

    def watch(self) -> None:
        """Take note of connections that came and went; close those that are too many."""
        while self.monitor.poll(0):
            event = recv_monitor_message(self.monitor)
            descriptor = event["value"]
            self._changes.pop(descriptor, None)
            if event["event"] == zmq.EVENT_DISCONNECTED:
                self._connected.discard(descriptor)
            elif len(self._connected) >= CONNECTIONS or time.monotonic() < self._open_from_s:
                self._close(descriptor)
            else:
                self._connected.add(descriptor)

    def count_change(self, message: zmq.Frame) -> None:
        """Count a change of subscriptions; close its connection if there were too many."""
        try:
            descriptor = int(message.get(zmq.SRCFD))
        except zmq.ZMQError:  # the connection has gone, and its subscriptions end
            return
        self._changes[descriptor] += 1
        if self._changes[descriptor] == CHANGES:
            self._open_from_s = time.monotonic() + _PAUSE_S
            self._close(descriptor)

    def _close(self, descriptor: int) -> None:
        """Shut a connection down; ZeroMQ closes it then. Another file may have its number by now, and is left alone."""
        with suppress(OSError):
            connection = socket.socket(fileno=descriptor)
            try:
                if connection.getsockname()[1:2] == (self._port,):
                    connection.shutdown(socket.SHUT_RDWR)
            finally:
                connection.detach()
