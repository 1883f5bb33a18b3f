"""ZeroMQ publisher of live results, which never waits for a subscriber."""

import ipaddress
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import zmq

from app.acquisition.streams.guard import ConnectionGuard, limit
from app.acquisition.streams.messages import TOPICS, message
from app.acquisition.wakeup_pipe import WakeupPipe
from app.bench.config import Bench
from app.errors import RunError
from app.measurement.measurement import Measurement

_WAITING = 4  # measurements queued for the publisher; beyond, the oldest is dropped
_QUEUED = 30  # messages queued per subscriber, ten measurements; beyond, new ones are dropped for it
_BUFFER_BYTES = 1 << 18  # system buffer per subscriber; a larger one would only delay messages
_CHANGES_AT_ONCE = 100  # between measurements
_LINGER_MS = 300  # time to send the last messages


class Publisher:
    """Sends measurements to subscribers in its own thread; other topics are not computed."""

    def __init__(self, bench: Bench) -> None:
        """Open the port of `bench.streams`; `RunError` if that fails."""
        self._bench = bench
        self._waiting: deque[tuple[int, Measurement]] = deque(maxlen=_WAITING)
        self._closing = threading.Event()
        self._wakeup = WakeupPipe()
        self._sequence = 0
        self._subscriptions: set[bytes] = set()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)  # a PUB socket that receives the subscriptions
        for option, value in ((zmq.SNDHWM, _QUEUED), (zmq.SNDBUF, _BUFFER_BYTES), (zmq.LINGER, _LINGER_MS)):
            self._socket.setsockopt(option, value)
        limit(self._socket)
        endpoint = f"tcp://{bench.streams.address}:{bench.streams.port}"
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            self._wakeup.close()
            raise RunError(
                f"nothing can be published at {endpoint}: {zmq.strerror(error.errno or 0)};"
                " change streams.port or streams.address"
            ) from error
        self._guard = ConnectionGuard(self._socket, bench.streams.port or 0)
        self._thread = threading.Thread(target=self._work, name="publisher", daemon=True)
        self._thread.start()

    def take(self, measurement: Measurement) -> None:
        """Queue a measurement; returns at once."""
        self._sequence += 1
        self._waiting.append((self._sequence, measurement))
        self._wakeup.notify()

    def close(self) -> None:
        """Send the queued measurements and close the port."""
        self._closing.set()
        self._wakeup.notify()
        self._thread.join()
        self._socket.disable_monitor()
        self._guard.join()
        self._context.destroy()
        self._wakeup.close()

    def _work(self) -> None:
        poller = zmq.Poller()
        for each in (self._socket, self._wakeup):
            poller.register(each, zmq.POLLIN)
        is_last = False
        while not is_last:
            poller.poll()
            self._wakeup.clear()
            is_last = self._closing.is_set()  # before the queue is emptied: what was taken before goes out
            self._read_subscriptions()
            while self._waiting:
                sequence, measurement = self._waiting.popleft()
                self._read_subscriptions()
                for topic in TOPICS:
                    is_wanted = any(topic.encode().startswith(prefix) for prefix in self._subscriptions)
                    if is_wanted and (parts := message(topic, sequence, measurement, self._bench)):
                        self._socket.send_multipart(parts, zmq.NOBLOCK)  # dropped for subscribers that are behind

    def _read_subscriptions(self) -> None:
        """Read subscriptions, some at a time: a byte, 1 to begin or 0 to end, and a topic prefix."""
        for _ in range(_CHANGES_AT_ONCE):
            if not self._socket.poll(0):
                break
            change = self._socket.recv()
            if change[:1] == b"\x01":
                self._subscriptions.add(change[1:])
            elif change[:1] == b"\x00":
                self._subscriptions.discard(change[1:])


@contextmanager
def stream_sinks(bench: Bench) -> Iterator[tuple[Callable[[Measurement], None], ...]]:
    """Yield the sinks that publish a bench's results; none without a port."""
    if bench.streams.port is None:
        yield ()
        return
    if not ipaddress.IPv4Address(bench.streams.address).is_loopback:
        sys.stderr.write(
            f"warning: every computer that reaches {bench.streams.address} can read the results at port"
            f" {bench.streams.port}\n"
        )
    with closing(Publisher(bench)) as publisher:
        yield (publisher.take,)
