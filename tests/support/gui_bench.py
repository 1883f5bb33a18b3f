"""Fake devices for tests of the window: the camera paints soft squares displaced by a known sample."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import cache

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.measurement.measurement import FrameTotals, Measurement
from drivers.interface import (
    BadValue,
    Camera,
    CameraCapabilities,
    Devices,
    DeviceTimeout,
    Frame,
    LightSource,
    Range,
    Stage,
)
from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement, LensletStatus, diagonal_covariance
from reconstruction.geometry import Field, Lattice
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from reconstruction.wavefront import Wavefront
from support.light_log import LightLog
from support.optics import sensor_of

FULL_SCALE = 65535
_LONG_S = 0.1
SENSOR = sensor_of(9, 13)
LATTICE = Lattice(center_x_px=215.0, center_y_px=150.5, pitch_px=31.25)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
# Nothing is left to choose, and there is no response: a reference is prepared three times as fast.
BENCH = Bench(
    sensor=SENSOR,
    field=FIELD,
    lattice=LATTICE,
    registration=RegistrationSettings(warp="quadratic"),
    reconstruction=ReconstructionSettings(method="modal", pupil_modes=28, response=False),
)


class FakeCamera(Camera):
    """Images its light and stage, every `period_s`, never in a long exposure; a read raises `fault` if set."""

    name = "fake camera"

    def __init__(self, *, rows: int = 300, columns: int = 430, lattice: Lattice = LATTICE) -> None:
        super().__init__()
        self.light = FakeLight()
        self.stage: Stage = FakeStage()
        self.fault: Exception | None = None
        self.period_s = 0.02
        self._capabilities = CameraCapabilities(
            rows=rows,
            columns=columns,
            pixel_pitch_m=16e-6,
            full_scale=FULL_SCALE,
            exposure_range_s=Range(0.01, 10),
            em_gain_range=Range(1, 1200),
            amplifiers=("em", "normal"),
            readout_speeds=(3,),  # as in the bench
        )
        self._exposure, self._chosen, self._gain, self._running = 0.02, "em", 1.0, False
        self._index, self._frames, self._last_s = 0, 0, 0.0  # frames since the start, and since it was opened
        self._images = [_squares((rows, columns), lattice, strength) for strength in (0.0, 1.0)]

    @property
    def is_closed(self) -> bool:
        return self.state == "closed"

    def _read_capabilities(self) -> CameraCapabilities:
        return self._capabilities

    def _read_exposure(self) -> float:
        return self._exposure

    def _set_exposure(self, exposure_s: float) -> float:
        if 0.05 < exposure_s < 0.06:
            raise BadValue("exposures between 50 and 60 ms are broken")
        self._exposure = round(exposure_s, 3)
        return self._exposure

    def _read_amplifier(self) -> str:
        return self._chosen

    def _set_amplifier(self, amplifier: str) -> None:
        self._chosen = amplifier

    def _read_em_gain(self) -> float:
        return self._gain

    def _set_em_gain(self, em_gain: float) -> float:
        self._gain = em_gain
        return em_gain

    def _is_running(self) -> bool:
        return self._running

    def _start(self) -> None:
        self._running, self._index, self._last_s = True, 0, time.monotonic()

    def _stop(self) -> None:
        self._running = False

    def _read(self, timeout_s: float) -> Frame:
        if self.fault is not None:
            raise self.fault
        left_s = self._last_s + self.period_s - time.monotonic() if self._exposure <= _LONG_S else math.inf
        time.sleep(max(0.0, min(left_s, timeout_s)))
        if left_s > timeout_s:
            raise DeviceTimeout("no frame yet")
        self._last_s = time.monotonic()
        counts = 500 + 40000 * self._images[self.stage.is_sample_in] * self.light.is_on
        noise = _noise(counts.shape)
        counts += noise[self._frames % len(noise)]
        frame = make_frame(counts.astype(np.uint16), index=self._index)
        self._index, self._frames = self._index + 1, self._frames + 1
        return frame

    def _close(self) -> None:
        self._running = False


class FakeLight(LightSource):
    name = "fake light"

    def __init__(self) -> None:
        super().__init__(sleep=lambda _: None)
        self._current, self.shines = 0.35, False
        self.log = LightLog()
        self._begin()

    def _read_range(self) -> Range:
        return Range(0, 1)

    def _read_current(self) -> float:
        return self._current

    def _set_current(self, current_a: float) -> float:
        self._current = current_a
        self.log.note(is_on=self.shines, level=current_a * self.shines)
        return current_a

    def _is_lit(self) -> bool:
        return self.shines

    def _switch(self, *, on: bool) -> None:
        self.shines = on
        self.log.note(is_on=on, level=self._current * on)

    def _close(self) -> None:
        pass


class FakeStage(Stage):
    name = "fake stage"

    def __init__(self) -> None:
        super().__init__()
        self._chosen, self._in = "square", False

    def _read_masks(self) -> tuple[str, ...]:
        return ("square", "stars")

    def _read_mask(self) -> str:
        return self._chosen

    def _set_mask(self, mask: str) -> None:
        self._chosen = mask

    def _is_sample_in(self) -> bool:
        return self._in

    def _set_sample_in(self, *, is_in: bool) -> None:
        self._in = is_in

    def _close(self) -> None:
        self._in = False


def opener(camera: FakeCamera) -> Callable[[Bench, Callable[[float], None]], Devices]:
    """Return a function that opens the devices around `camera`."""

    def open_devices(_: Bench, progress: Callable[[float], None]) -> Devices:
        with ExitStack() as stack:
            for device in (camera, camera.stage, camera.light):
                stack.callback(device.close)
            progress(1.0)  # raises if the window was closed meanwhile
            return Devices(camera, camera.light, camera.stage, stack.pop_all())

    return open_devices


def make_frame(pixels: NDArray[np.uint16], *, index: int = 0) -> Frame:
    now_s = time.perf_counter()
    return Frame(pixels=pixels, index=index, camera_time_s=now_s, host_time_s=now_s, exposure_s=0.02, em_gain=1.0)


def make_measurement(
    pixels: NDArray[np.uint16],
    views: Floats,
    *,
    outcome: NDArray[np.int8] | None = None,
    displacement_px: Floats | None = None,
    index: int = 0,
) -> Measurement:
    """Make a measurement from arrays, as from a recording."""
    shape = views.shape[2:]
    outcome = np.zeros(shape, np.int8) if outcome is None else outcome
    coefficients = np.zeros((*shape, 3, 2))
    if displacement_px is not None:
        coefficients[:, :, 0] = displacement_px
    coefficients[outcome != LensletStatus.CONVERGED] = np.nan
    displacement = Displacement(
        LegendreModes(3),
        coefficients,
        diagonal_covariance(np.zeros_like(coefficients)),
        outcome,
        *np.zeros((3, *shape)),
    )
    wavefront = Wavefront(SENSOR, FIELD, displacement, _NoSolution(shape), views, FREE)  # type: ignore[arg-type] # a stand-in
    return Measurement(
        make_frame(pixels, index=index), wavefront, "", FrameTotals(index + 1, index + 1, 0), time.perf_counter(), 0.004
    )


class _NoSolution:
    """A wavefront without errors."""

    def __init__(self, lenslets: tuple[int, ...]) -> None:
        self._lenslets = lenslets

    def wavefront(self, field_modes: Floats) -> Floats:
        raise NotImplementedError

    def sigma(self, field_modes: Floats) -> Floats:
        return np.zeros((*field_modes.shape[:-1], *self._lenslets))


@cache
def _noise(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Noise of the next frames of a camera, counts, (frame, row, column): of a dark, a reference and some more."""
    made = np.random.default_rng(1).normal(0, 30, (64, *shape)).astype(np.float32)
    made.flags.writeable = False
    return made


@cache
def _squares(shape: tuple[int, int], lattice: Lattice, strength: float) -> Floats:
    """Soft squares behind every lenslet, 0 ... 1, displaced by a sample of the given strength; read-only."""
    y, x = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    position = lattice.from_camera_px(np.stack([x, y], axis=-1).astype(np.float64)) / lattice.pitch_px
    cell = np.floor(position + 0.5)
    u, v = cell[..., 0] / 7, cell[..., 1] / 7
    inside = (position - cell) * lattice.pitch_px
    half = FIELD.half_width_px(SENSOR)
    moved_x = strength * (1.6 * np.sin(2.1 * u + 0.4) * np.cos(1.7 * v) + 0.6 * v * inside[..., 0] / half)
    moved_y = strength * (1.6 * np.cos(1.5 * u) * np.sin(2.3 * v - 0.3) + 0.6 * u * inside[..., 1] / half)
    brightness = np.ones(shape)
    for offset in (inside[..., 0] - moved_x, inside[..., 1] - moved_y):
        brightness *= 0.5 * (np.tanh((offset + half) / 1.2) - np.tanh((offset - half) / 1.2))
    brightness.flags.writeable = False
    return brightness
