"""Publisher of measurements: into a ring in shared memory for the instrument's clients, and by ZeroMQ for others.

It works in its own thread, never waits for anybody, and does nothing for a frame that nobody takes.
"""

import ipaddress
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from app.acquisition.serialization import Message
from app.acquisition.streams.messages import DETAILS, SHARED, TOPICS, calibration_facts, own_frame, topic_message
from app.acquisition.streams.ring import RingWriter
from app.bench.config import Bench
from app.errors import RunError
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement

_WAITING = 8  # measurements that wait for the thread; beyond, the oldest is dropped
_KEPT, _KEPT_AT_LEAST = 50, 16  # newest records of which clients may ask for more: 2 s of those for a window
_KEPT_BYTES = 1 << 26  # of pixels, that may make it fewer
_SPARE = 1.5  # a slot's size over that of the first record which needs it
_QUEUED = 30  # messages queued per subscriber, ten measurements; beyond, new ones are dropped for it
_BUFFER_BYTES = 1 << 18  # system buffer per subscriber; a larger one would only delay messages
_TOPIC_BYTES = 64  # longest message of a subscriber: a longer one closes its connection
_SUBSCRIBED_S = 0.1  # between two looks for subscriptions
_CHANGES_AT_ONCE = 100  # of subscriptions, between measurements
_HANDSHAKE_MS = 2000
_LINGER_MS = 300  # time to send the last messages


@dataclass(frozen=True, slots=True)
class _Taken:
    sequence: int  # among all that were offered
    count: int  # of the record for clients; 0: none, because the frame was skipped
    measurement: Measurement
    is_shown_only: bool


class Publisher:
    """Takes measurements from the worker; `running` sends them."""

    def __init__(
        self, bench: Bench, ring_file: Path | None = None, notify: Callable[[], object] = lambda: None
    ) -> None:
        """Write a ring if a `ring_file` names it where memory needs a name; `notify` follows each new one."""
        self._bench, self._ring_file, self._notify = bench, ring_file, notify
        self._pause_s = math.inf  # of the client that reads most often
        self._sequence = 0
        self.count = 0  # of the measurements that clients may read
        self._waiting, self._unwritten = deque[_Taken](maxlen=_WAITING), list[_Taken]()
        self._written_s = -math.inf
        self._ring: RingWriter | None = None
        self.ring_name = ""
        self._kept, self._shared = dict[int, Measurement](), dict[str, tuple[Any, int]]()
        self._facts: tuple[Calibration | None, str] | None = None
        self._subscriptions = set[bytes]()
        self._wakeup, self._closing = threading.Event(), threading.Event()
        self._problem = ""  # the last one that was printed

    def take(self, measurement: Measurement, *, is_shown_only: bool = False) -> None:
        """Publish a measurement, or a routine's frame, which clients only show; returns at once."""
        self._sequence += 1
        self.count += not measurement.is_skipped
        if not (is_taken := bool(self._subscriptions) or math.isfinite(self._pause_s)):
            self._waiting.clear()  # but for the newest: a client may come
        was_empty = not self._waiting
        count = 0 if measurement.is_skipped else self.count
        self._waiting.append(_Taken(self._sequence, count, measurement, is_shown_only))
        if is_taken and (was_empty or self._subscriptions or self._pause_s == 0):
            self._wakeup.set()

    def read_every(self, pause_s: float) -> None:
        """Write as often as the fastest client reads, every `pause_s`; all measurements if 0, none if infinite."""
        self._pause_s = pause_s
        self._wakeup.set()

    def part(self, name: str, count: int) -> Any:
        """Return a part of the record with a count, see `SHARED` and `DETAILS`; `RunError` if it is too old."""
        if (measurement := self._kept.get(count)) is None:
            raise RunError(f"there is no {name} of frame {count}")
        return (SHARED | DETAILS)[name](measurement)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Open the port of `bench.streams`, if there is one, and publish; `RunError` if that fails."""
        with ExitStack() as at_end:
            at_end.callback(self._close_ring)
            socket = None if self._bench.streams.port is None else _open_port(at_end, self._bench)
            thread = threading.Thread(target=self._work, args=(socket,), name="publisher", daemon=True)
            if socket is not None or self._ring_file is not None:
                thread.start()
                at_end.callback(thread.join)
            at_end.callback(self._wakeup.set)
            at_end.callback(self._closing.set)
            yield

    def _close_ring(self) -> None:
        if self._ring is not None:
            self._ring.close()  # readers that have it open keep what they have

    def _work(self, socket: "zmq.Socket[bytes] | None") -> None:
        is_last = False
        while not is_last:
            self._wakeup.wait(self._wait_s)
            self._wakeup.clear()
            is_last = self._closing.is_set()  # before the queue is emptied: what was taken before goes out
            try:
                self._publish_waiting(socket)
            except Exception as error:  # noqa: BLE001 - of one frame; it is printed, once
                if (problem := f"svwfs: a frame was not published: {error!r}\n") != self._problem:
                    self._problem = problem
                    sys.stderr.write(problem)

    @property
    def _wait_s(self) -> float:
        """Longest wait for a measurement: until the next record is due, or other programs may have subscribed."""
        due_s = self._due_s if self._waiting or self._unwritten else math.inf
        return max(min(due_s - time.monotonic(), _SUBSCRIBED_S), 0.0)

    @property
    def _due_s(self) -> float:
        """Time of the next record: twice as often as a client reads, so that it reads what is new."""
        return self._written_s + self._pause_s / 2 if math.isfinite(self._pause_s) else math.inf

    def _publish_waiting(self, socket: "zmq.Socket[bytes] | None") -> None:
        if socket is not None:
            self._read_subscriptions(socket)
        is_due = time.monotonic() >= self._due_s
        while is_due or self._subscriptions:
            try:
                taken = self._waiting.popleft()
            except IndexError:  # `take` drops measurements, too
                break
            if socket is not None:
                self._read_subscriptions(socket)
                self._send_topics(socket, taken)
            if taken.count:
                self._unwritten = [taken]
            if self._pause_s == 0:
                self._write()
        if is_due:
            self._write()

    def _write(self) -> None:
        """Write the newest measurement into the ring, if that has not been done."""
        if self._ring_file is None or not self._unwritten:
            return
        taken = self._unwritten.pop()
        count, measurement, is_shown_only = taken.count, taken.measurement, taken.is_shown_only
        try:
            message = Message(own_frame(measurement, self._keep(count, measurement), is_shown_only=is_shown_only))
        except Exception as error:  # noqa: BLE001 - of this frame, whose clients are informed
            lean = Measurement(measurement.frame, None, f"this frame cannot be shown: {error}", measurement.counts)
            message = Message(own_frame(lean, {}, is_shown_only=is_shown_only))
        if self._ring is None or not self._ring.has_room_for(message):
            self._close_ring()
            self._ring = RingWriter(int(_SPARE * message.nbytes), self._ring_file)
        self._ring.write(message, count)
        self._written_s = time.monotonic()
        if self.ring_name != self._ring.name:
            self.ring_name = self._ring.name
            self._notify()

    def _keep(self, count: int, measurement: Measurement) -> dict[str, int]:
        """Keep what clients may ask for; return since which record the shared parts are the same."""
        self._kept[count] = measurement
        most = min(max(_KEPT_BYTES // measurement.frame.pixels.nbytes, _KEPT_AT_LEAST), _KEPT)
        for old in list(self._kept)[:-most]:
            del self._kept[old]
        since = dict[str, int]()
        for name, find in SHARED.items():
            if (part := find(measurement)) is not None:
                if self._shared.get(name, (None, 0))[0] is not part:
                    self._shared[name] = part, count
                since[name] = self._shared[name][1]
        return since

    def _send_topics(self, socket: "zmq.Socket[bytes]", taken: _Taken) -> None:
        measurement = taken.measurement
        if taken.is_shown_only or not self._subscriptions:
            return
        calibration = measurement.calibration
        bench = self._bench if calibration is None else calibration.bench
        if self._facts is None or self._facts[0] is not calibration:
            self._facts = calibration, calibration_facts(calibration, bench)
        for topic in TOPICS:
            is_wanted = any(topic.encode().startswith(prefix) for prefix in self._subscriptions)
            if is_wanted and (parts := topic_message(topic, taken.sequence, measurement, bench, self._facts[1])):
                socket.send_multipart(parts, zmq.NOBLOCK)  # dropped for subscribers that are behind

    def _read_subscriptions(self, socket: "zmq.Socket[bytes]") -> None:
        """Read subscriptions, some at a time: a byte, 1 to begin or 0 to end, and a topic prefix."""
        for _ in range(_CHANGES_AT_ONCE):
            if not socket.poll(0):
                break
            change = socket.recv()
            if change[:1] == b"\x01":
                self._subscriptions.add(change[1:])
            elif change[:1] == b"\x00":
                self._subscriptions.discard(change[1:])


def _open_port(at_end: ExitStack, bench: Bench) -> "zmq.Socket[bytes]":
    """Open the port of `bench.streams` until the end; `RunError` if that fails."""
    if not ipaddress.IPv4Address(bench.streams.address).is_loopback:
        sys.stderr.write(
            f"warning: every computer that reaches {bench.streams.address} can read the results at port"
            f" {bench.streams.port}\n"
        )
    socket = at_end.enter_context(
        at_end.enter_context(zmq.Context()).socket(zmq.XPUB)
    )  # a PUB socket that receives the subscriptions
    options = {zmq.SNDHWM: _QUEUED, zmq.SNDBUF: _BUFFER_BYTES, zmq.LINGER: _LINGER_MS}
    options |= {zmq.MAXMSGSIZE: _TOPIC_BYTES, zmq.HANDSHAKE_IVL: _HANDSHAKE_MS, zmq.RCVHWM: _CHANGES_AT_ONCE}
    for option, value in options.items():
        socket.setsockopt(option, value)
    endpoint = f"tcp://{bench.streams.address}:{bench.streams.port}"
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        raise RunError(
            f"nothing can be published at {endpoint}: {zmq.strerror(error.errno or 0)};"
            " change streams.port or streams.address"
        ) from error
    return socket
