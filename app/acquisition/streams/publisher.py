"""A ZeroMQ publisher of live results: whoever connects hears the newest, and nobody is ever waited for."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import zmq

from app.acquisition.streams.messages import TOPICS, message
from app.bench.config import Bench
from app.errors import RunError
from app.measurement.measurement import Measurement

_WAITING = 4  # measurements between worker and publisher; beyond, the oldest is dropped
_QUEUED = 30  # messages for one subscriber, ten measurements; beyond, it misses the newest until it has caught up
_BUFFER_BYTES = 1 << 18  # of the system for one subscriber: more would only make what it hears older
_LINGER_MS = 300  # at the end, for messages that are still on their way


class Publisher:
    """Sends every measurement that it is given, from a thread of its own, to the programs that have subscribed.

    What nobody has subscribed to is not even computed.
    """

    def __init__(self, bench: Bench) -> None:
        """Open the port of `bench.streams`; `RunError` when that cannot be."""
        self._bench = bench
        self._waiting: deque[tuple[int, Measurement]] = deque(maxlen=_WAITING)
        self._something_new, self._closing = threading.Event(), threading.Event()
        self._sequence = 0
        self._subscriptions: set[bytes] = set()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)  # a PUB that knows what is subscribed to
        for option, value in ((zmq.SNDHWM, _QUEUED), (zmq.SNDBUF, _BUFFER_BYTES), (zmq.LINGER, _LINGER_MS)):
            self._socket.setsockopt(option, value)
        endpoint = f"tcp://{bench.streams.address}:{bench.streams.port}"
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise RunError(
                f"nothing can be published at {endpoint}: {zmq.strerror(error.errno or 0)};"
                " change streams.port or streams.address"
            ) from error
        self._thread = threading.Thread(target=self._work, name="publisher", daemon=True)
        self._thread.start()

    def take(self, measurement: Measurement) -> None:
        """Have a measurement sent; returns at once."""
        self._sequence += 1
        self._waiting.append((self._sequence, measurement))
        self._something_new.set()

    def close(self) -> None:
        """Send what waits, and close the port."""
        self._closing.set()
        self._something_new.set()
        self._thread.join()
        self._context.destroy()

    def _work(self) -> None:
        while not self._closing.is_set():
            self._something_new.wait()
            self._something_new.clear()
            while self._waiting:
                sequence, measurement = self._waiting.popleft()
                self._note_subscriptions()
                for topic in TOPICS:
                    if any(topic.encode().startswith(prefix) for prefix in self._subscriptions):
                        self._send(message(topic, sequence, measurement, self._bench))

    def _send(self, parts: list[bytes]) -> None:
        if parts:
            self._socket.send_multipart(parts, zmq.NOBLOCK)  # a subscriber that has not kept up misses it

    def _note_subscriptions(self) -> None:
        """Read who has come and gone: a byte, 1 or 0, before the beginning of the topics that are meant."""
        while self._socket.poll(0):
            told = self._socket.recv()
            if told[:1] == b"\x01":
                self._subscriptions.add(told[1:])
            elif told[:1] == b"\x00":
                self._subscriptions.discard(told[1:])


@contextmanager
def stream_sinks(bench: Bench) -> Iterator[tuple[Callable[[Measurement], None], ...]]:
    """Give the sinks through which the bench wants its results to be heard elsewhere: none, when it says nothing."""
    if bench.streams.port is None:
        yield ()
        return
    with closing(Publisher(bench)) as publisher:
        yield (publisher.take,)
