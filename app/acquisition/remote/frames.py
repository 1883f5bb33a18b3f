"""Frames of another process's instrument, with their wavefronts: the newest on a thread, or every one.

The wavefront is solved here from the displacements, as it was there. Preparing that takes a second, in which commands
and signs of life must go on.
"""

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from functools import lru_cache
from typing import Any

from app.acquisition.remote.messages import NewFrame, RingRecord
from app.acquisition.remote.ring import RingReader
from app.acquisition.remote.serialization import Absent, unpacked
from app.errors import RunError
from app.measurement.calibration import Calibration
from app.measurement.estimator import Estimator
from app.measurement.measurement import Measurement
from app.progress import run_in_thread
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.reconstructor import Reconstructor
from reconstruction.runtime.threads import one_blas_thread

_WAIT_S = 0.1
_ESTIMATORS = 2  # kept: two references may alternate
_AHEAD_BYTES = 512e6  # of pixels that are read while an estimator is prepared
_REPLACED_S = 3.0  # for the notice of the next ring, after one could not be opened


class RemoteFrames:
    """Reads the ring of an instrument: every newest measurement goes to the sinks, and lies in `newest`."""

    def __init__(
        self, find: Callable[[int], Any], sinks: tuple[Callable[[Measurement], None], ...], pause_s: float
    ) -> None:
        """`find` returns an object by its number, or raises `Absent`; a pause follows each measurement."""
        self._find, self._sinks, self._pause_s = find, sinks, pause_s
        self.newest: Measurement | None = None
        self.error: Exception | None = None  # that ended the thread
        self._preparation, self._looking_up = lru_cache(_ESTIMATORS)(_prepare), threading.Lock()
        self.overtaken = 0  # records that the instrument replaced before, or while, they were read here
        self._missed, self._counting = bytearray(), threading.Lock()  # 1 for each of them, by its count
        self._new_frame, self._has_news = NewFrame("", 0), threading.Condition()
        self._outdated = 0  # count of a record
        self._closing, self._delivering = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._work, name="connection frames", daemon=True)
        self._thread.start()

    def every(self) -> Iterator[Measurement]:
        """Yield each measurement from now on, in order and once, but those that `overtaken` counts.

        While an estimator is prepared, which takes seconds, the frames that come are read ahead.
        """
        return self._each(_Follower(self._note_missed, self._new_frame.count, is_every_read=True))

    def announce(self, new_frame: NewFrame) -> None:
        """Note that there is a newer record."""
        with self._has_news:
            self._new_frame = new_frame
            self._has_news.notify_all()

    def outdate(self, count: int) -> None:
        """Keep records up to a count from the sinks: they were measured before a command was executed."""
        with self._delivering:
            self._outdated = max(self._outdated, count)

    def close(self) -> None:
        """End the thread, soon."""
        self._closing.set()
        with self._has_news:
            self._has_news.notify_all()

    def join(self, timeout_s: float | None = None) -> None:
        """Wait for the end of the thread."""
        self._thread.join(timeout_s)

    def _work(self) -> None:
        try:
            # Another thread of BLAS would take processor time from the instrument by waiting busily.
            with one_blas_thread(), closing(_Follower(self._note_missed)) as follower:
                while not self._closing.is_set():
                    new_frame = self._new_frame
                    if (record := self._next(follower, new_frame)) is None:
                        self._wait_for_news(new_frame)
                    else:
                        due_s = time.monotonic() + self._pause_s
                        self._deliver(record, follower.count)
                        self._closing.wait(due_s - time.monotonic())
        except Exception as error:  # noqa: BLE001 - the connection ends with it
            self.error = error

    def _each(self, follower: "_Follower") -> Iterator[Measurement]:
        ahead, most = deque[Measurement](), 1
        with closing(follower):
            while True:
                new_frame, is_over = self._new_frame, self._closing.is_set()
                if ahead and (is_over or self._is_prepared(ahead[0])):
                    yield self._solved(ahead.popleft())
                elif len(ahead) < most and (record := self._next(follower, new_frame)) is not None:
                    if not record.is_shown_only:
                        ahead.append(record.measurement)
                        most = int(_AHEAD_BYTES / record.measurement.frame.pixels.nbytes)
                elif is_over and not ahead:
                    return
                else:
                    self._wait_for_news(new_frame)

    def _note_missed(self, count: int) -> None:
        """Count a record that a reader has missed, unless another one has, too."""
        with self._counting:
            self._missed.extend(bytes(max(count + 1 - len(self._missed), 0)))
            self.overtaken += not self._missed[count]
            self._missed[count] = 1

    def _wait_for_news(self, new_frame: NewFrame) -> None:
        """Wait for another notice; not for long, as an absent object comes without one."""
        with self._has_news:
            self._has_news.wait_for(lambda: self._new_frame is not new_frame or self._closing.is_set(), _WAIT_S)

    def _next(self, follower: "_Follower", new_frame: NewFrame) -> RingRecord | None:
        """The record that a follower reads next; None if it is not there yet, or lacks an object."""
        if not new_frame.ring or (found := follower.next(new_frame.ring)) is None:
            return None
        count, body = found
        try:
            record: RingRecord = unpacked(body, self._find)
        except Absent:
            return None
        follower.count = count
        return record

    def _deliver(self, record: RingRecord, count: int) -> None:
        measurement = self._solved(record.measurement)
        with self._delivering:
            if not record.is_shown_only and count > self._outdated:
                for sink in self._sinks:
                    sink(measurement)
        self.newest = measurement

    def _reconstructor(self, calibration: Calibration) -> Future[Reconstructor]:
        """Return the reconstructor of a calibration, which the first call begins to prepare."""
        with self._looking_up:
            return self._preparation(calibration)

    def _is_prepared(self, made: Measurement) -> bool:
        return made.problem != "" or made.calibration is None or self._reconstructor(made.calibration).done()

    def _solved(self, made: Measurement) -> Measurement:
        if made.problem or made.calibration is None or made.registered is None:
            return made
        try:
            reconstructor = self._reconstructor(made.calibration).result()
            bias, sample = made.assumed.refinement.bias, made.assumed.sample or FREE
            return replace(made, wavefront=reconstructor.solve(made.registered, bias=bias, sample=sample))
        except ReconstructionError as error:
            return replace(made, problem=str(error))


def _prepare(calibration: Calibration) -> Future[Reconstructor]:
    return run_in_thread(lambda: Estimator(calibration).reconstructor, "estimator")[0]


class _Follower:
    """One reader of an instrument's ring, and of the larger ones that may replace it."""

    def __init__(self, note_missed: Callable[[int], None], count: int = 0, *, is_every_read: bool = False) -> None:
        """Read the newest record after a count, or each one; `note_missed` is called with the count of one missed."""
        self.count, self._note_missed, self._is_every_read = count, note_missed, is_every_read  # of the last read
        self._ring: tuple[str, RingReader] | None = None
        self._missing = "", 0.0  # the name of a ring that cannot be opened, and since when

    def next(self, ring_name: str) -> tuple[int, bytes] | None:
        """Return the count and a copy of the next record in the ring of a name; None if there is none yet."""
        while (ring := self._at(ring_name)) is not None and (newest := ring.count) > self.count:
            count = self.count + 1 if self._is_every_read else newest
            if (body := ring.read(count)) is not None:
                return count, body
            self._note_missed(count)
            self.count = count
        return None

    def close(self) -> None:
        """Give the ring back."""
        if self._ring is not None:
            self._ring[1].close()

    def _at(self, ring_name: str) -> RingReader | None:
        """The ring of a name, or the one before it until all is read there; None if it is replaced already."""
        if self._ring is not None and (
            self._ring[0] == ring_name or (self._is_every_read and self._ring[1].count > self.count)
        ):
            return self._ring[1]
        try:
            opened = RingReader(ring_name)
        except (OSError, ValueError, struct.error) as error:
            now_s = time.monotonic()
            if self._missing[0] != ring_name:  # another notice should be coming
                self._missing = ring_name, now_s
            if now_s > self._missing[1] + _REPLACED_S:
                raise RunError(
                    f"its memory cannot be opened from here ({error}): this program may run in another"
                    " container; start it where the instrument runs"
                ) from error
            return None
        self.close()
        self._ring = ring_name, opened
        return opened
