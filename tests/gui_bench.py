"""Devices for the tests of the window: a camera that paints soft squares, moved by a sample that is known exactly."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from app.acquisition import Counts, Measurement
from app.config import Bench
from app.devices import Devices
from drivers.interface import (
    BadValue,
    Camera,
    CameraCapabilities,
    DeviceTimeout,
    Frame,
    LightSource,
    Range,
    Stage,
    WrongState,
)
from reconstruction.displacement import Displacement, Outcome, diagonal_covariance
from reconstruction.field_modes import LegendreModes
from reconstruction.geometry import Field, Floats, Lattice, Sensor
from reconstruction.pipeline import ReconstructionSettings
from reconstruction.wavefront import Wavefront

FULL_SCALE = 65535
SENSOR = Sensor(
    lenslet_rows=9,
    lenslet_columns=13,
    lenslet_pitch_m=500e-6,
    lenslet_focal_length_m=46.7e-3,
    wavelength_m=462e-9,
    pixel_pitch_m=16e-6,
)
LATTICE = Lattice(center_x_px=215.0, center_y_px=150.5, pitch_px=31.25)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
BENCH = Bench(
    sensor=SENSOR, field=FIELD, lattice=LATTICE, reconstruction=ReconstructionSettings(method="modal", pupil_modes=28)
)


class FakeCamera(Camera):
    """Takes frames of the light and the stage beside it; `fault` is raised by the next read."""

    name = "fake camera"

    def __init__(self, *, rows: int = 300, columns: int = 430, lattice: Lattice = LATTICE) -> None:
        self.light, self.stage = FakeLight(), FakeStage()
        self.fault: Exception | None = None
        self.is_closed = False
        self.period_s = 0.02
        exposures, gains = Range(0.01, 10), Range(1, 1200)
        self._capabilities = CameraCapabilities(rows, columns, 16e-6, FULL_SCALE, exposures, ("em", "normal"), gains)
        self._exposure_s, self._amplifier, self._em_gain, self._running = 0.02, "em", 1.0, False
        self._index, self._started_s = 0, 0.0
        self._images = [_squares((rows, columns), lattice, strength) for strength in (0.0, 1.0)]
        self._noise = np.random.default_rng(1)

    @property
    def capabilities(self) -> CameraCapabilities:
        return self._capabilities

    @property
    def exposure_s(self) -> float:
        return self._exposure_s

    def set_exposure(self, exposure_s: float) -> float:
        if 0.05 < exposure_s < 0.06:
            raise BadValue("exposures between 50 and 60 ms are broken")
        self._exposure_s = round(self._capabilities.exposure_range_s.check(exposure_s, "exposure_s"), 3)
        return self._exposure_s

    @property
    def amplifier(self) -> str:
        return self._amplifier

    def set_amplifier(self, amplifier: str) -> None:
        if self._running:
            raise WrongState("stop first")
        self._amplifier = amplifier

    @property
    def em_gain(self) -> float:
        return self._em_gain

    def set_em_gain(self, em_gain: float) -> float:
        self._em_gain = em_gain
        return em_gain

    @property
    def is_running(self) -> bool:
        return self._running

    def start(self) -> None:
        self._running, self._index, self._started_s = True, 0, time.perf_counter()

    def stop(self) -> None:
        self._running = False

    def read(self, timeout_s: float) -> Frame:
        if self.fault is not None:
            raise self.fault
        if self._exposure_s > timeout_s:
            time.sleep(timeout_s)
            raise DeviceTimeout("no frame yet")
        time.sleep(self.period_s)
        counts = 500 + 40000 * self._images[self.stage.is_sample_in] * self.light.is_on
        counts += self._noise.normal(0, 30, counts.shape)
        frame = make_frame(counts.astype(np.uint16), index=self._index)
        self._index += 1
        return frame

    def close(self) -> None:
        self.is_closed, self._running = True, False


class FakeLight(LightSource):
    name = "fake light"
    current_range_a = Range(0, 1)

    def __init__(self) -> None:
        self._current_a, self._on = 0.35, False

    @property
    def current_a(self) -> float:
        return self._current_a

    def set_current(self, current_a: float) -> float:
        self._current_a = current_a
        return current_a

    @property
    def is_on(self) -> bool:
        return self._on

    def set_on(self, on: bool) -> None:
        self._on = on

    def close(self) -> None:
        self._on = False


class FakeStage(Stage):
    masks = ("square", "stars")

    def __init__(self) -> None:
        self._mask, self._in = "square", False

    @property
    def mask(self) -> str:
        return self._mask

    def set_mask(self, mask: str) -> None:
        self._mask = mask

    @property
    def is_sample_in(self) -> bool:
        return self._in

    def set_sample_in(self, sample_in: bool) -> None:
        self._in = sample_in

    def close(self) -> None:
        self._in = False


def opener(camera: FakeCamera) -> Callable[[Bench, Callable[[float], None]], Devices]:
    """Return what opens the devices around `camera`."""

    def open_devices(_: Bench, progress: Callable[[float], None]) -> Devices:
        progress(1.0)
        devices = Devices(camera, camera.light, camera.stage)
        for device in (camera, camera.stage, camera.light):
            devices._closing.callback(device.close)
        return devices

    return open_devices


def make_frame(pixels: NDArray[np.uint16], *, index: int = 0) -> Frame:
    now_s = time.perf_counter()
    return Frame(pixels, index, now_s, now_s, 0.02, 1.0)


def make_measurement(
    pixels: NDArray[np.uint16],
    views: Floats,
    *,
    outcome: NDArray[np.int8] | None = None,
    displacement_px: Floats | None = None,
    index: int = 0,
) -> Measurement:
    """Make a measurement of arrays alone, as it would come from a recording."""
    shape = views.shape[2:]
    outcome = np.zeros(shape, np.int8) if outcome is None else outcome
    coefficients = np.zeros((*shape, 3, 2))
    if displacement_px is not None:
        coefficients[:, :, 0] = displacement_px
    coefficients[outcome != Outcome.CONVERGED] = np.nan
    displacement = Displacement(
        LegendreModes(3),
        coefficients,
        diagonal_covariance(np.zeros_like(coefficients)),
        outcome,
        *np.zeros((3, *shape)),
    )
    wavefront = Wavefront(FIELD, displacement, _NoSolution(), views)
    return Measurement(
        make_frame(pixels, index=index), wavefront, "", Counts(index + 1, index + 1, 0), time.perf_counter(), 0.004
    )


class _NoSolution:
    def wavefront(self, field_modes: Floats) -> Floats:
        raise NotImplementedError

    def sigma(self, field_modes: Floats) -> Floats:
        raise NotImplementedError


def _squares(shape: tuple[int, int], lattice: Lattice, strength: float) -> Floats:
    """Soft squares behind every lenslet, between 0 and 1, moved as by a sample of the given strength."""
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
    return brightness
