"""Frames of another process's instrument, with their wavefronts: the newest on a thread, or every one.

What the instrument has computed arrives with each frame. The rest is asked for when it is needed, and computed here
from the pixels if the instrument does not answer.
"""

import math
import struct
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from app.acquisition.frame_path import Sink
from app.acquisition.serialization import unpacked
from app.acquisition.streams.messages import DETAILS, OF_DISPLACEMENT, OwnFrame
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

_POLL_S, _IDLE_POLL_S = 0.004, 0.02  # between two looks for a new record: at 1000 per second the ring has room for 8 ms
_ANSWER_S = 2.0  # for a detail; then it is computed here
_REPLACED_S = 3.0  # for the name of the next ring, after one could not be opened

Ask: TypeAlias = Callable[[str, int], Future[Any]]
"""Asks the instrument for a part of the record with a count; see `Publisher.part`."""


class RemoteFrames:
    """Reads the ring of an instrument: every newest measurement goes to the sinks, and lies in `newest`."""

    def __init__(self, ask: Ask, sinks: tuple[Sink, ...], pause_s: float) -> None:
        """A pause follows each measurement."""
        self._ask, self._sinks, self._pause_s = ask, sinks, pause_s
        self.ring_name = ""  # of the instrument's present ring, once known
        self.count = 0  # of the newest known record
        self.newest: Measurement | None = None
        self.error: Exception | None = None  # that ended the thread
        self.overtaken = 0  # records that the instrument replaced before, or while, `every` read them
        self._shared, self._asking = dict[str, tuple[int, Any]](), threading.Lock()
        self._outdated = 0  # count of a record
        self._closing, self._delivering = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._work, name="connection frames", daemon=True)
        self._thread.start()

    def every(self) -> Iterator[Measurement]:
        """Yield each measurement from now on, in order and once, but those that `overtaken` counts."""
        records = self._records(self.count, is_every_read=True)
        return (measurement for _, frame, measurement in records if not frame.is_shown_only)

    def outdate(self, count: int) -> None:
        """Keep records up to a count from the sinks: they were measured before a command was executed."""
        with self._delivering:
            self._outdated = max(self._outdated, count)

    def close(self) -> None:
        """End the thread, soon."""
        self._closing.set()

    def join(self, timeout_s: float | None = None) -> None:
        """Wait for the end of the thread."""
        self._thread.join(timeout_s)

    def _work(self) -> None:
        try:
            # Another thread of BLAS would take processor time from the instrument by waiting busily.
            with one_blas_thread(), closing(self._records(0, is_every_read=False)) as records:
                for count, frame, measurement in records:
                    due_s = time.monotonic() + self._pause_s
                    with self._delivering:
                        if not frame.is_shown_only and count > self._outdated:
                            for sink in self._sinks:
                                sink(measurement)
                    self.newest, self.count = measurement, max(count, self.count)
                    if self._closing.wait(due_s - time.monotonic()):
                        return
        except Exception as error:  # noqa: BLE001 - the connection ends with it
            self.error = error

    def _records(self, count: int, *, is_every_read: bool) -> Generator[tuple[int, OwnFrame, Measurement]]:
        """Yield the newest record whenever there is another, or every one after a count; until the end."""
        name, ring, missing_s = "", None, math.inf  # until another ring should be named
        wait_s = _POLL_S
        with ExitStack() as opened:
            while True:
                is_over, wanted = self._closing.is_set(), self.ring_name  # before the last look at the ring
                if ring is not None and (newest := ring.count) > count:
                    count, wait_s = count + 1 if is_every_read else newest, _POLL_S
                    if (body := ring.read(count)) is None:
                        self.overtaken += is_every_read
                    elif (found := self._measurement(count, body)) is not None:
                        yield count, *found
                elif name != wanted and (another := _opened(wanted, is_late=time.monotonic() > missing_s)) is not None:
                    opened.close()
                    opened.callback(another.close)
                    name, ring, missing_s = wanted, another, math.inf
                elif is_over:
                    return
                else:
                    missing_s = math.inf if name == wanted else min(missing_s, time.monotonic() + _REPLACED_S)
                    self._closing.wait(wait_s)
                    wait_s = min(1.2 * wait_s, _IDLE_POLL_S)

    def _measurement(self, count: int, body: bytes) -> tuple[OwnFrame, Measurement] | None:
        """The frame of a record; None if a shared part of it does not arrive, as the instrument has ended."""
        frame: OwnFrame = unpacked(body)
        try:
            shared = {name: self._part(name, since, count) for name, since in frame.shared.items()}
        except (RunError, DeviceError):
            return None
        made = replace(frame.lean, calibration=shared.get("calibration"))
        if frame.arrays:
            made = _with_wavefront(made, shared, frame.arrays, lambda name: self._ask(name, count))
        return frame, made

    def _part(self, name: str, since: int, count: int) -> Any:
        """Return a shared part that is the same since a record; the first call asks for it."""
        with self._asking:
            if self._shared.get(name, (0,))[0] != since:
                self._shared[name] = since, self._ask(name, count).result()
            return self._shared[name][1]


def _opened(name: str, *, is_late: bool) -> RingReader | None:
    """Open a ring; None if that fails, as it is replaced already: `RunError` if another name should have come."""
    try:
        return RingReader(name)
    except (OSError, ValueError, struct.error) as error:
        if is_late:
            raise RunError(
                f"its memory cannot be opened from here ({error}): this program may run in another container; start it"
                " where the instrument runs"
            ) from error
        return None


def _with_wavefront(
    made: Measurement, shared: dict[str, Any], arrays: dict[str, Any], ask: Callable[[str], Future[Any]]
) -> Measurement:
    """Return a measurement with its displacements and wavefront, whose costly parts are asked for when needed."""
    calibration: Calibration = shared["calibration"]
    solved_here = Deferred(lambda: replace(made, wavefront=_solved_here(made, calibration, absorbs=arrays["absorbs"])))

    def detail(name: str) -> Deferred[Any]:
        def find() -> Any:
            try:
                return ask(name).result(_ANSWER_S)
            except (RunError, DeviceError, TimeoutError):  # the frame is too old, or the instrument has ended
                return DETAILS[name](solved_here())

        return Deferred(find)

    sensor, bias = calibration.bench.sensor, made.assumed.refinement.bias
    registered = Displacement(
        shared["field_modes"],
        arrays["displacement"],
        detail("covariance"),
        **{name: arrays[name] for name in OF_DISPLACEMENT},
        transmission_source=detail("transmission"),
    )
    displacement = registered if bias is None else registered.minus(bias)
    solution: Solution
    if (pupil_modes := shared.get("pupil_modes")) is not None:
        known, root = _known(pupil_modes, arrays["known"].tobytes()), detail("root_covariance")
        solution = ModalSolution(
            coefficients=arrays["coefficients"],
            _known=known,
            # The root of the covariance as components that deviate by 1.
            _deviations=Deferred(
                lambda: Deviations(Spread(root(), known), np.ones(root().shape[2], np.float32), root()[..., :0])
            ),
            noise=arrays["noise"],
            freedom=arrays["freedom"],
            _displacement=displacement,
            parameters=shared["parameters"],
            fitted=detail("fitted"),
        )
    else:
        solution = ZonalSolution(sensor, displacement, arrays["weights"])
    sample, field, views = made.assumed.sample or FREE, calibration.bench.field, arrays["wavefront"]
    wavefront = Wavefront(sensor, field, displacement, solution, views, sample, detail("sigma"))
    return replace(made, registered=registered, wavefront=wavefront)


@lru_cache(maxsize=4)
def _known(modes: PupilModes, lenslets: bytes) -> KnownModes:
    return known_modes(modes, np.frombuffer(lenslets, np.bool_).reshape(modes.inside.shape), extrapolate=False)


def _solved_here(made: Measurement, calibration: Calibration, *, absorbs: bool) -> Wavefront:
    """Register and solve a frame again; the estimator of its calibration is prepared first, which takes seconds."""
    bias, sample = made.assumed.refinement.bias, made.assumed.sample or FREE
    with one_blas_thread():
        reconstructor = calibration.reconstructor()
        displacement = reconstructor.register(made.frame.pixels, absorbs=absorbs)
        return reconstructor.solve(displacement, bias=bias, sample=sample)
