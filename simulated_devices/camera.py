"""The camera of the simulated bench; frames come at their own pace, read or not."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.interface import NO_FRAME, Camera, CameraCapabilities, DeviceTimeout, Frame, Range, Region
from simulated_devices.detector import Detector, FrameConditions

if TYPE_CHECKING:
    from simulated_devices.bench import ReceivedLight, SimulatedBench
    from simulated_devices.settings import Amplifier

_RING_FRAMES = 8
_EXPOSURE_STEPS_PER_S = 100_000
_SLICE_S = 0.05
_REGION_STEP_PX = 16
_STATES_REMEMBERED = 1000
_NOISY_BYTES = 1 << 27  # of frames that are repeated


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """Frames with the same settings; frame i ends at start_s + (i + 1 - first_index) * exposure_s."""

    first_index: int
    start_s: float
    exposure_s: float
    em_gain: float

    def end_s(self, index: int) -> float:
        """End of the exposure of a frame."""
        return self.start_s + (index + 1 - self.first_index) * self.exposure_s

    def complete(self, time_s: float) -> int:
        """Index of the first frame that is not complete at `time_s`."""
        # 1e-6: rounding must not cost a frame.
        return self.first_index + max(0, math.floor((time_s - self.start_s) / self.exposure_s + 1e-6))


class _Shot(NamedTuple):
    """Everything on which the pixels of a frame depend."""

    received: ReceivedLight
    exposure: FrameConditions
    part: Region

    def light(self) -> tuple[NDArray[np.float32], np.float32]:
        """Image (row, column) of the part, and its dose: their product are mean photons."""
        part, (image, dose) = self.part, self.received.light
        rows, columns = slice(part.top, part.top + part.rows), slice(part.left, part.left + part.columns)
        return np.ascontiguousarray(image[rows, columns]), dose

    def key(self) -> object:
        """Key that another shot has only if its pixels are the same, as long as this one lives."""
        return tuple((id(image), float(dose)) for image, dose in self.received.parts), self.exposure, self.part


class SimulatedCamera(Camera):
    """An EMCCD with frame transfer: it exposes during the readout, so that the period is the exposure.

    Complete frames wait in a ring of eight; a slower reader finds a gap in `Frame.index`. A region lies in steps of
    16 pixels and takes as long to read out as the whole sensor.
    """

    def __init__(self, bench: SimulatedBench) -> None:
        super().__init__()
        settings = bench.camera_settings
        self._bench, self._settings, self._name = bench, settings, "Simulated C9100-23B"
        self._detector = Detector(settings, seed=bench.simulation.seed)
        self._sensor = self._part = Region(0, 0, settings.rows, settings.columns)
        self._chosen_amplifier: Amplifier = settings.amplifier
        self._em_readout_speed = settings.readout_speed
        self._chosen_exposure_s = _rounded(settings.exposure_s)
        self._chosen_em_gain = settings.em_gain
        self._runs: list[_Run] = []  # the last is the present one; earlier ones have unread frames
        self._next_index = 0
        self._starts = 0
        self._states: OrderedDict[int, int | None] = OrderedDict()
        # While a frame is used, the next one is computed as if nothing changed: a real camera takes no time of ours.
        self._ahead = ThreadPoolExecutor(1, "detector")
        self._expected: Future[tuple[_Shot, NDArray[np.uint16]]] | None = None
        self._noisy: OrderedDict[object, tuple[_Shot, NDArray[np.uint16]]] = OrderedDict()  # repeated frames

    def state_of_frame(self, index: int) -> int | None:
        """State of the sample in one of the last 1000 frames since the start; None without the sample."""
        return self._states[index]

    def _read_capabilities(self) -> CameraCapabilities:
        settings, has_multiplier = self._settings, self._chosen_amplifier == "em"
        return CameraCapabilities(
            rows=self._part.rows,
            columns=self._part.columns,
            pixel_pitch_m=self._bench.sensor.pixel_pitch_m,
            full_scale=2**settings.bits - 1,
            exposure_range_s=settings.exposure_range_s(self._chosen_amplifier, self._em_readout_speed),
            em_gain_range=Range(1.0, settings.maximum_em_gain if has_multiplier else 1.0),
            amplifiers=("normal", "em"),
            readout_speeds=(1, 2, 3) if has_multiplier else (1,),
            sensor=self._sensor,
            region_step_px=_REGION_STEP_PX,
        )

    def _read_exposure(self) -> float:
        return self._chosen_exposure_s

    def _set_exposure(self, exposure_s: float) -> float:
        """Round to 10 us; while running, restart the present exposure."""
        self._chosen_exposure_s = _rounded(exposure_s)
        if self._runs:
            now_s = self._bench.clock.now()
            self._continue(replace(self._runs[-1], start_s=now_s, exposure_s=self._chosen_exposure_s), now_s)
        return self._chosen_exposure_s

    def _read_em_gain(self) -> float:
        return self._chosen_em_gain

    def _set_em_gain(self, em_gain: float) -> float:
        """Takes effect in the frame that is being exposed."""
        self._chosen_em_gain = em_gain
        if self._runs:
            run, now_s = self._runs[-1], self._bench.clock.now()
            frames = run.complete(now_s) - run.first_index
            self._continue(replace(run, start_s=run.start_s + frames * run.exposure_s, em_gain=em_gain), now_s)
        return em_gain

    def _read_amplifier(self) -> str:
        return self._chosen_amplifier

    def _set_amplifier(self, amplifier: str) -> None:
        """Move exposure and gain into the new ranges."""
        self._chosen_amplifier = "normal" if amplifier == "normal" else "em"
        self._move_into_ranges()

    def _read_readout_speed(self) -> int:
        return self._em_readout_speed if self._chosen_amplifier == "em" else 1

    def _set_readout_speed(self, readout_speed: int) -> None:
        """Move the exposure into the new range."""
        if self._chosen_amplifier == "em":
            self._em_readout_speed = readout_speed
        self._move_into_ranges()

    def _read_region(self) -> Region:
        return self._part

    def _set_region(self, region: Region) -> Region:
        self._part = region
        return region

    def _is_running(self) -> bool:
        return bool(self._runs)

    def _start(self) -> None:
        self._next_index = 0
        self._starts += 1
        self._states.clear()
        now_s = self._bench.clock.now()
        self._runs = [
            _Run(first_index=0, start_s=now_s, exposure_s=self._chosen_exposure_s, em_gain=self._chosen_em_gain)
        ]

    def _stop(self) -> None:
        self._runs = []

    def _read(self, timeout_s: float) -> Frame:
        clock = self._bench.clock
        deadline_s = clock.now() + timeout_s
        while True:
            now_s = clock.now()
            complete = self._runs[-1].complete(now_s)
            if complete > self._next_index:
                index = max(self._next_index, complete - _RING_FRAMES)
                self._next_index = index + 1
                return self._frame(index)
            if now_s >= deadline_s:
                raise DeviceTimeout(NO_FRAME)
            end_s = self._run_of(self._next_index).end_s(self._next_index)
            clock.sleep(max(1e-5, min(end_s - now_s, deadline_s - now_s, _SLICE_S)))

    def _close(self) -> None:
        self._runs = []
        self._ahead.shutdown()

    def _move_into_ranges(self) -> None:
        allowed = self._read_capabilities()
        self._chosen_exposure_s = allowed.exposure_range_s.nearest(self._chosen_exposure_s)
        self._chosen_em_gain = allowed.em_gain_range.nearest(self._chosen_em_gain)

    def _continue(self, run: _Run, now_s: float) -> None:
        """Use other settings from the first incomplete frame on."""
        complete = self._runs[-1].complete(now_s)
        self._runs = [past for past in self._runs if past.first_index < complete]
        self._runs.append(replace(run, first_index=complete))

    def _run_of(self, index: int) -> _Run:
        return next(run for run in reversed(self._runs) if run.first_index <= index)

    def _shot(self, run: _Run, index: int, light: Callable[[float, float], ReceivedLight]) -> _Shot:
        """What the present settings and the light during its exposure give frame number `index`."""
        end_s = run.end_s(index)
        exposure = FrameConditions(
            index=(self._starts << 40) + index,  # each start has its own noise
            exposure_s=run.exposure_s,
            amplifier=self._chosen_amplifier,
            readout_speed=self._read_readout_speed(),
            em_gain=run.em_gain,
        )
        return _Shot(light(end_s - run.exposure_s, end_s), exposure, self._part)

    def _frame(self, index: int) -> Frame:
        run = self._run_of(index)
        shot = self._shot(run, index, self._bench.expose)
        self._runs = [past for past in self._runs if past.first_index >= run.first_index]
        self._states[index] = shot.received.state
        while len(self._states) > _STATES_REMEMBERED:
            self._states.popitem(last=False)
        pixels = self._pixels(shot, index)
        pixels.setflags(write=False)
        return Frame(
            pixels=pixels,
            index=index,
            camera_time_s=run.end_s(index),
            host_time_s=self._bench.clock.now(),
            exposure_s=run.exposure_s,
            em_gain=run.em_gain,
        )

    def _pixels(self, shot: _Shot, index: int) -> NDArray[np.uint16]:
        """Counts of a frame, and begin to compute the next one's."""
        if noises := self._settings.noise_frames:
            return self._repeated(shot._replace(exposure=replace(shot.exposure, index=index % noises)))
        found = self._expected.result() if self._expected else None
        if found is None or found[0].key() != shot.key():
            found = self._computed(shot)
        run = self._run_of(index + 1)
        self._expected = self._ahead.submit(lambda: self._computed(self._shot(run, index + 1, self._bench.expected)))
        return found[1]

    def _computed(self, shot: _Shot) -> tuple[_Shot, NDArray[np.uint16]]:
        image, dose = shot.light()
        return shot, self._detector.counts(image, shot.exposure, dose=dose)

    def _repeated(self, shot: _Shot) -> NDArray[np.uint16]:
        """Copy of the frame that is the same, which is computed the first time."""
        if (found := self._noisy.get(shot.key())) is None:
            found = self._noisy[shot.key()] = self._computed(shot)
            while len(self._noisy) * found[1].nbytes > _NOISY_BYTES:
                self._noisy.popitem(last=False)
        return found[1].copy()


def _rounded(exposure_s: float) -> float:
    return round(exposure_s * _EXPOSURE_STEPS_PER_S) / _EXPOSURE_STEPS_PER_S
