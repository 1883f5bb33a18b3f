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
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import zmq

from app.acquisition.streams.messages import (
    DETAILS,
    TOPICS,
    NewFrame,
    SharedObjects,
    calibration_facts,
    own_message,
    topic_message,
)
from app.acquisition.streams.ring import RingWriter
from app.acquisition.wakeup_pipe import WakeupPipe
from app.bench.config import Bench
from app.errors import RunError
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from reconstruction.runtime.deferred import Deferred
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront

_WAITING = 8  # measurements that wait for the thread; beyond, the oldest is dropped
_DETAILED_S = 3.0  # in which clients may ask for details of a record
_COMPLETE = 16  # newest records that keep all, some hundred kilobytes each; older ones lose the transmission
_SPARE = 1.5  # a slot's size over that of the first record which needs it
_QUEUED = 30  # messages queued per subscriber, ten measurements; beyond, new ones are dropped for it
_BUFFER_BYTES = 1 << 18  # system buffer per subscriber; a larger one would only delay messages
_TOPIC_BYTES = 64  # longest message of a subscriber: a longer one closes its connection
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
        """Write a ring if a `ring_file` names it where memory needs a name; `notify` follows each record."""
        self._bench, self._ring_file, self._notify = bench, ring_file, notify
        self._pause_s = math.inf  # of the client that reads most often
        self._sequence = 0
        self.count = 0  # of the measurements that clients may read
        self._waiting, self._unwritten = deque[_Taken](maxlen=_WAITING), list[_Taken]()
        self._asked = deque[tuple[Future[Any], str, int]]()
        self._written_s = -math.inf
        self._rings = deque[RingWriter](maxlen=2)  # the newest last; a reader may be about to open the one before
        self._shared, self._detailed = SharedObjects(), dict[int, tuple[float, Wavefront | None]]()
        self._facts: tuple[Calibration | None, str] | None = None
        self._subscriptions = set[bytes]()
        self._wakeup, self._closing = WakeupPipe(), threading.Event()
        self.newest = NewFrame("", 0)
        self.error: Exception | None = None  # that ended the thread

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
            self._wakeup.notify()

    def read_every(self, pause_s: float) -> None:
        """Write as often as the fastest client reads, every `pause_s`; all measurements if 0, none if infinite."""
        self._pause_s = pause_s
        self._wakeup.notify()

    def detail(self, name: str, number: int) -> Future[Any]:
        """Return a shared object, or a detail of the frame with that count; `RunError` if it is too old."""
        future: Future[Any] = Future()
        if self._closing.is_set():
            raise RunError("the acquisition has ended")
        self._asked.append((future, name, number))
        self._wakeup.notify()
        return future

    @contextmanager
    def running(self) -> Iterator[None]:
        """Open the port of `bench.streams`, if there is one, and publish; `RunError` if that fails."""
        with ExitStack() as at_end:
            for end in (self._wakeup.close, self._close_rings):  # readers that have a ring open keep what they have
                at_end.callback(end)
            socket = None if self._bench.streams.port is None else _open_port(at_end, self._bench)
            thread = threading.Thread(target=self._work, args=(socket,), name="publisher", daemon=True)
            if socket is not None or self._ring_file is not None:
                thread.start()
                at_end.callback(thread.join)
            at_end.callback(self._wakeup.notify)
            at_end.callback(self._closing.set)
            yield

    def _close_rings(self) -> None:
        for ring in self._rings:
            ring.close()

    def _work(self, socket: "zmq.Socket[bytes] | None") -> None:
        poller, is_last = zmq.Poller(), False
        for each in (self._wakeup, socket):
            if each is not None:
                poller.register(each, zmq.POLLIN)
        try:
            while not is_last:
                poller.poll(self._timeout_ms())
                self._wakeup.clear()
                is_last = self._closing.is_set()  # before the queue is emptied: what was taken before goes out
                self._publish_waiting(socket)
        except Exception as error:  # noqa: BLE001 - the instrument ends with it
            self.error = error
            self._notify()

    def _timeout_ms(self) -> int | None:
        if not (self._waiting or self._unwritten) or math.isinf(self._pause_s):
            return None
        return max(math.ceil(1e3 * (self._due_s - time.monotonic())), 0)

    @property
    def _due_s(self) -> float:
        """Time of the next record: twice as often as a client reads, so that it reads what is new."""
        return self._written_s + self._pause_s / 2 if math.isfinite(self._pause_s) else math.inf

    def _publish_waiting(self, socket: "zmq.Socket[bytes] | None") -> None:
        if socket is not None:
            self._read_subscriptions(socket)
        is_due = time.monotonic() >= self._due_s
        while self._waiting and (is_due or self._subscriptions):
            taken = self._waiting.popleft()
            if socket is not None:
                self._read_subscriptions(socket)
                self._send_topics(socket, taken)
            if taken.count:
                self._unwritten = [taken]
            if self._pause_s == 0:
                self._write()
        if is_due:
            self._write()
        while self._asked:
            self._answer(*self._asked.popleft())

    def _write(self) -> None:
        """Write the newest measurement into the ring, if that has not been done."""
        if self._ring_file is None or not self._unwritten:
            return
        taken = self._unwritten.pop()
        count, measurement, is_shown_only = taken.count, taken.measurement, taken.is_shown_only
        try:
            message = own_message(measurement, self._shared, is_shown_only=is_shown_only)
        except RunError as error:
            lean = Measurement(measurement.frame, None, f"this frame cannot be shown: {error}", measurement.counts)
            message = own_message(lean, self._shared, is_shown_only=is_shown_only)
        if not self._rings or not self._rings[-1].has_room_for(message):
            if len(self._rings) == self._rings.maxlen:
                self._rings.popleft().close()
            self._rings.append(RingWriter(int(_SPARE * message.nbytes), self._ring_file, count=count - 1))
        self._keep(count, measurement.wavefront)
        self._rings[-1].write(message, count)
        self._written_s = time.monotonic()
        self.newest = NewFrame(self._rings[-1].name, count)
        self._notify()

    def _keep(self, count: int, wavefront: Wavefront | None) -> None:
        """Keep a wavefront for the details that clients may ask for."""
        now_s = time.monotonic()
        self._detailed[count] = now_s, wavefront
        while now_s > self._detailed[oldest := next(iter(self._detailed))][0] + _DETAILED_S:
            del self._detailed[oldest]
        if len(self._detailed) > _COMPLETE:
            old = list(self._detailed)[-_COMPLETE - 1]
            written_s, complete = self._detailed[old]
            self._detailed[old] = written_s, None if complete is None else _lean(complete)

    def _answer(self, future: Future[Any], name: str, number: int) -> None:
        try:
            if name == "object":
                future.set_result(self._shared.get(number))
            elif name in DETAILS and (wavefront := self._detailed.get(number, (0.0, None))[1]) is not None:
                future.set_result(DETAILS[name](wavefront))
            else:
                future.set_exception(RunError(f"there is no {name} of frame {number}"))
        except Exception as error:  # noqa: BLE001 - of this answer alone
            future.set_exception(error)

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


def _lean(wavefront: Wavefront) -> Wavefront | None:
    """Return a wavefront without what its transmission is computed from; None if that is not possible."""
    if not isinstance(wavefront.solution, ModalSolution):
        return None
    displacement = replace(wavefront.displacement, transmission_source=Deferred(_refuse))
    solution = replace(wavefront.solution, _displacement=displacement)
    return replace(wavefront, displacement=displacement, solution=solution)


def _refuse() -> None:
    raise RunError("this transmission is no longer known")


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
