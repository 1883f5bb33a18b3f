"""Frames of another process's instrument, with their wavefronts: the newest on a thread, or every one.

What the instrument has computed arrives with each frame. The rest is asked for when it is needed, and computed here
from the pixels if the instrument does not answer.
"""

import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from app.acquisition.serialization import unpacked_frame
from app.acquisition.streams.messages import DETAILS, OF_LENSLETS, SHARED, NewFrame, OwnFacts
from app.acquisition.streams.ring import RingReader
from app.errors import RunError
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from drivers.errors import DeviceError
from reconstruction.displacement import Displacement
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.runtime.deferred import Deferred
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.solve.modal import Deviations, KnownModes, ModalSolution, Spread, known_modes
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Solution, Wavefront

_WAIT_S = 0.1
_ANSWER_S = 2.0  # for a detail; then it is computed here
_REPLACED_S = 3.0  # for the notice of the next ring, after one could not be opened

Ask: TypeAlias = Callable[[str, int], Future[Any]]
"""Asks the instrument for a shared object, or for a detail of a frame; see `Publisher.detail`."""


class RemoteFrames:
    """Reads the ring of an instrument: every newest measurement goes to the sinks, and lies in `newest`."""

    def __init__(self, ask: Ask, sinks: tuple[Callable[[Measurement], None], ...], pause_s: float) -> None:
        """A pause follows each measurement."""
        self._ask, self._sinks, self._pause_s = ask, sinks, pause_s
        self.newest: Measurement | None = None
        self.error: Exception | None = None  # that ended the thread
        self._shared, self._asking = dict[int, Any](), threading.Lock()
        self.overtaken = 0  # records that the instrument replaced before, or while, they were read here
        self._missed, self._counting = bytearray(), threading.Lock()  # 1 for each of them, by its count
        self._new_frame, self._has_news = NewFrame("", 0), threading.Condition()
        self._outdated = 0  # count of a record
        self._closing, self._delivering = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._work, name="connection frames", daemon=True)
        self._thread.start()

    def every(self) -> Iterator[Measurement]:
        """Yield each measurement from now on, in order and once, but those that `overtaken` counts."""
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
                    new_frame, due_s = self._new_frame, time.monotonic() + self._pause_s
                    if (found := self._next(follower, new_frame)) is None:
                        self._wait_for_news(new_frame)
                        continue
                    facts, measurement = found
                    with self._delivering:
                        if not facts.is_shown_only and follower.count > self._outdated:
                            for sink in self._sinks:
                                sink(measurement)
                    self.newest = measurement
                    self._closing.wait(due_s - time.monotonic())
        except Exception as error:  # noqa: BLE001 - the connection ends with it
            self.error = error

    def _each(self, follower: "_Follower") -> Iterator[Measurement]:
        with closing(follower):
            while True:
                new_frame, is_over = self._new_frame, self._closing.is_set()
                if (found := self._next(follower, new_frame)) is not None:
                    if not found[0].is_shown_only:
                        yield found[1]
                elif is_over:
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
        """Wait for another notice."""
        with self._has_news:
            self._has_news.wait_for(lambda: self._new_frame is not new_frame or self._closing.is_set(), _WAIT_S)

    def _next(self, follower: "_Follower", new_frame: NewFrame) -> tuple[OwnFacts, Measurement] | None:
        """The frame that a follower reads next; None if it is not there yet, or an object of it does not arrive."""
        if not new_frame.ring or (found := follower.next(new_frame.ring)) is None:
            return None
        count, body = found
        facts, arrays = unpacked_frame(body)
        try:
            calibration, *modes = (None if each is None else self._object(each) for each in facts[2:])
        except (RunError, DeviceError, TimeoutError):  # the instrument stands still, or ends
            return None
        follower.count = count
        made = replace(facts.measurement, calibration=calibration)
        if calibration is None or modes[0] is None:
            return facts, made
        return facts, _with_wavefront(made, calibration, modes, arrays, lambda name: self._ask(name, count))

    def _object(self, number: int) -> Any:
        """Return a shared object, which the first call asks for."""
        with self._asking:
            if number not in self._shared:
                self._shared[number] = self._ask("object", number).result(_ANSWER_S)
                if len(self._shared) > SHARED:
                    del self._shared[min(self._shared)]
            return self._shared[number]


def _with_wavefront(
    made: Measurement,
    calibration: Calibration,
    modes: Iterable[Any],
    arrays: dict[str, NDArray[Any]],
    ask: Callable[[str], Future[Any]],
) -> Measurement:
    """Return a measurement with its displacements and wavefront, whose costly parts are asked for when needed."""
    solved_here = Deferred(lambda: _solved_here(made, calibration))

    def detail(name: str) -> Deferred[Any]:
        def find() -> Any:
            try:
                return ask(name).result(_ANSWER_S)
            except (RunError, DeviceError, TimeoutError):  # the frame is too old, or the instrument has ended
                return DETAILS[name](solved_here())

        return Deferred(find)

    sensor, bias = calibration.bench.sensor, made.assumed.refinement.bias
    field_modes, pupil_modes, parameters = modes
    of_lenslets: dict[str, Any] = {name: arrays[name] for name in OF_LENSLETS}
    registered = Displacement(
        field_modes,
        arrays["displacement"],
        detail("covariance"),
        **of_lenslets,
        transmission_source=detail("transmission"),
    )
    displacement = registered if bias is None else registered.minus(bias)
    solution: Solution
    if pupil_modes is not None:
        known, root = _known(pupil_modes, arrays["known"].tobytes()), detail("root_covariance")
        freedom, noise = arrays["freedom_and_noise"].tolist()
        solution = ModalSolution(
            coefficients=arrays["coefficients"],
            _known=known,
            # The root of the covariance as components that deviate by 1.
            _deviations=Deferred(
                lambda: Deviations(Spread(root(), known), np.ones(root().shape[2], np.float32), root()[..., :0])
            ),
            noise=noise,
            freedom=freedom,
            _displacement=displacement,
            parameters=parameters,
            fitted=detail("fitted"),
        )
    else:
        solution = ZonalSolution(sensor, displacement, arrays.get("weights"))
    sample, field, views = made.assumed.sample or FREE, calibration.bench.field, arrays["wavefront"]
    wavefront = Wavefront(sensor, field, displacement, solution, views, sample, detail("sigma"))
    return replace(made, registered=registered, wavefront=wavefront)


@lru_cache(maxsize=4)
def _known(modes: PupilModes, lenslets: bytes) -> KnownModes:
    return known_modes(modes, np.frombuffer(lenslets, np.bool_).reshape(modes.inside.shape), extrapolate=False)


def _solved_here(made: Measurement, calibration: Calibration) -> Wavefront:
    """Register and solve a frame again; the estimator of its calibration is prepared first, which takes seconds."""
    bias, sample = made.assumed.refinement.bias, made.assumed.sample or FREE
    with one_blas_thread():
        reconstructor = calibration.reconstructor()
        return reconstructor.solve(reconstructor.register(made.frame.pixels), bias=bias, sample=sample)


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
