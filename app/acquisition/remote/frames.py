"""The newest frames of another process's instrument, with their wavefronts, on a thread of their own.

The wavefront is solved here from the displacements, as it was there. Preparing that takes a second, in which commands
and signs of life must go on.
"""

import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from app.acquisition.remote.messages import Notice, RingRecord
from app.acquisition.remote.ring import RingReader
from app.acquisition.remote.wire import Absent, unpacked
from app.measurement.calibration import Calibration
from app.measurement.estimator import Estimator
from app.measurement.measurement import Measurement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.runtime.threads import one_blas_thread

_WAIT_S = 0.1
_ESTIMATORS = 2  # kept: two references may alternate


class NewestFrames:
    """Reads the ring of an instrument; every newest measurement goes to the sinks, and lies in `newest`."""

    def __init__(
        self, find: Callable[[int], Any], sinks: tuple[Callable[[Measurement], None], ...], pause_s: float
    ) -> None:
        """`find` returns an object that travels by itself, or raises `Absent`; a pause follows each measurement."""
        self._find, self._sinks, self._pause_s = find, sinks, pause_s
        self.newest: Measurement | None = None
        self.error: Exception | None = None  # that ended the thread
        self._estimators: OrderedDict[int, tuple[Calibration, Estimator]] = OrderedDict()
        self._ring: tuple[str, RingReader] | None = None
        self._notice: Notice | None = None
        self._read = self._outdated = 0  # counts of records
        self._due_s = 0.0
        self._has_news, self._closing, self._delivering = threading.Event(), threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._work, name="connection frames", daemon=True)
        self._thread.start()

    def announce(self, notice: Notice) -> None:
        """Note that there is a newer record."""
        self._notice = notice
        self._has_news.set()

    def try_again(self) -> None:
        """Read the newest record again, as an object that was absent has arrived."""
        self._has_news.set()

    def outdate(self, count: int) -> None:
        """Let no sink receive records up to a count any more: they were measured before a command was executed."""
        with self._delivering:
            self._outdated = max(self._outdated, count)

    def close(self) -> None:
        """End the thread, soon."""
        self._closing.set()
        self._has_news.set()

    def join(self, timeout_s: float | None = None) -> None:
        """Wait for the end of the thread."""
        self._thread.join(timeout_s)

    def _work(self) -> None:
        try:
            with one_blas_thread():  # another one would take processor time from the instrument by waiting busily
                while not self._closing.is_set():
                    self._has_news.wait(_WAIT_S)
                    self._has_news.clear()
                    self._closing.wait(self._due_s - time.monotonic())
                    if (notice := self._notice) is not None and notice.place:
                        self._read_newest(notice.place)
        except Exception as error:  # noqa: BLE001 - the connection ends with it
            self.error = error
        finally:
            if self._ring is not None:
                self._ring[1].close()

    def _read_newest(self, place: str) -> None:
        if self._ring is None or self._ring[0] != place:
            try:
                opened = RingReader(place)
            except (OSError, ValueError, struct.error):  # replaced already: another notice is coming
                return
            if self._ring is not None:
                self._ring[1].close()
            self._ring = place, opened
        ring = self._ring[1]
        count = ring.count
        if count <= self._read or self._closing.is_set():
            return
        body = ring.read(count)
        if body is None:  # overwritten meanwhile: there is a newer one
            self._has_news.set()
            return
        try:
            record: RingRecord = unpacked(body, self._find)
        except Absent:
            return
        self._read, self._due_s = count, time.monotonic() + self._pause_s
        measurement = self._solved(record)
        with self._delivering:
            if not record.is_shown_only and count > self._outdated:
                for sink in self._sinks:
                    sink(measurement)
        self.newest = measurement

    def _solved(self, record: RingRecord) -> Measurement:
        made = record.measurement
        if not record.has_wavefront or made.calibration is None or made.registered is None:
            return made
        try:
            reconstructor = self._estimator(made.calibration).reconstructor
            bias, sample = made.assumed.refinement.bias, made.assumed.sample or FREE
            return replace(made, wavefront=reconstructor.solve(made.registered, bias=bias, sample=sample))
        except ReconstructionError as error:
            return replace(made, problem=str(error))

    def _estimator(self, calibration: Calibration) -> Estimator:
        kept = self._estimators.get(id(calibration))
        if kept is None:
            kept = self._estimators[id(calibration)] = calibration, Estimator(calibration)
            while len(self._estimators) > _ESTIMATORS:
                self._estimators.popitem(last=False)
        return kept[1]
