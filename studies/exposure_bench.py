"""Minimal bench for routines that run thousands of times: any range, any lamp, no waiting.

Frames are drawn, not propagated; light, noise, saturation and rounding are those of a camera.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drivers.interface import Camera, CameraCapabilities, Devices, DeviceTimeout, Frame, LightSource, Range, Stage
from reconstruction.arrays import Floats
from simulated_devices.settings import SimulatedCameraSettings, SimulatedLightSettings, Simulation

PITCH_PX = 16.0
SIDE_PX = 160
_CAMERA, _LIGHT = SimulatedCameraSettings(), SimulatedLightSettings()


def squares(*, width_px: float = 8.0, background: float = 0.0) -> Floats:
    """Smoothed subimages of a square source, (row, column), maximum 1."""
    position = np.abs((np.arange(SIDE_PX) + 0.5) % PITCH_PX - PITCH_PX / 2)
    profile = 1 / (1 + np.exp((position - width_px / 2) / 0.7))
    image = np.outer(profile, profile)
    return np.asarray(background + (1 - background) * image / image.max())


def spots(*, first_zero_px: float = 2.7, pitch_px: float = 16.25) -> Floats:
    """Diffraction images of points at all positions between the pixels, (row, column), maximum at most 1."""
    position = (np.arange(SIDE_PX) + pitch_px / 2) % pitch_px - pitch_px / 2
    profile = np.sinc(position / first_zero_px) ** 2
    return np.asarray(np.outer(profile, profile))


@dataclass(kw_only=True)
class LampScene:
    """Lamp, camera and noise."""

    counts_per_a_s: float  # of the brightest pixel
    exposure_range_s: Range
    image: Floats = field(default_factory=squares)
    current_range_a: Range = Range(0.0, _LIGHT.maximum_current_a)
    droop: float = 1.0  # light ~ current to this power
    exposure_step_s: float = 1e-5
    bits: int = _CAMERA.bits
    offset_counts: float = _CAMERA.offset_counts
    read_noise_counts: float = 6.4
    counts_per_electron: float = 1 / _CAMERA.electrons_per_count
    well_counts: float = 1e9
    nonlinearity: float = _CAMERA.nonlinearity  # share that is lost of a signal at full scale
    ambient_counts_per_s: float = 0.0
    flicker: float = 0.0  # relative
    hot_pixels: int = 0
    cosmic_rays: int = 0  # in each frame
    seed: int = Simulation().seed


class ManyFramesCamera(Camera):
    """A camera that returns a frame at once."""

    def __init__(self, scene: LampScene, lamp: Lamp, exposure_s: float) -> None:
        super().__init__()
        self._name, self._scene, self._lamp, self._chosen_s = "Drawn camera", scene, lamp, exposure_s
        self._frames: int | None = None  # since the start; None while stopped
        self._time_s = 0.0
        self.exposed_s: list[float] = []
        self._random = np.random.default_rng(scene.seed)
        self._hot = self._random.integers(0, SIDE_PX, (2, scene.hot_pixels))

    def _read_capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(
            rows=SIDE_PX,
            columns=SIDE_PX,
            pixel_pitch_m=16e-6,
            full_scale=2**self._scene.bits - 1,
            exposure_range_s=self._scene.exposure_range_s,
        )

    def _read_exposure(self) -> float:
        return self._chosen_s

    def _set_exposure(self, exposure_s: float) -> float:
        step_s = self._scene.exposure_step_s
        self._chosen_s = round(exposure_s / step_s) * step_s
        return self._chosen_s

    def _is_running(self) -> bool:
        return self._frames is not None

    def _start(self) -> None:
        self._frames = 0

    def _stop(self) -> None:
        self._frames = None

    _close = _stop

    def _read(self, timeout_s: float) -> Frame:
        if timeout_s <= 0:
            raise DeviceTimeout("there is no time to wait for a frame")
        scene, random, exposure_s, index = self._scene, self._random, self._chosen_s, self._frames or 0
        light = scene.counts_per_a_s * self._lamp.current_a**scene.droop * self._lamp.is_on * exposure_s
        light *= 1 + scene.flicker * random.standard_normal()
        electrons = (scene.image * light + scene.ambient_counts_per_s * exposure_s) / scene.counts_per_electron
        noisy = electrons + np.sqrt(electrons) * random.standard_normal(electrons.shape)
        counts = np.clip(noisy * scene.counts_per_electron, 0, scene.well_counts)
        counts -= scene.nonlinearity / 2**scene.bits * counts**2
        counts += scene.offset_counts + scene.read_noise_counts * random.standard_normal(counts.shape)
        counts[tuple(self._hot)] = 1e9
        row, column = random.integers(0, SIDE_PX - 8, (2, scene.cosmic_rays))
        for step in range(8):  # a track
            counts[row + step, column + step // 2] += 30_000
        pixels = np.clip(np.rint(counts), 0, 2**scene.bits - 1).astype(np.uint16)
        pixels.setflags(write=False)
        self._frames = index + 1
        self.exposed_s.append(exposure_s)
        self._time_s += exposure_s
        return Frame(
            pixels=pixels,
            index=index,
            camera_time_s=self._time_s,
            host_time_s=self._time_s,
            exposure_s=exposure_s,
            em_gain=1.0,
        )


class Lamp(LightSource):
    """A light without faults."""

    def __init__(self, current_range_a: Range, current_a: float, *, is_on: bool) -> None:
        super().__init__(sleep=lambda _: None)
        self._name, self._allowed_a, self._chosen_a, self._shines = "Drawn lamp", current_range_a, current_a, False
        self._begin()
        self._shines = is_on

    def _read_range(self) -> Range:
        return self._allowed_a

    def _read_current(self) -> float:
        return self._chosen_a

    def _set_current(self, current_a: float) -> float:
        self._chosen_a = current_a
        return current_a

    def _is_lit(self) -> bool:
        return self._shines

    def _switch(self, *, on: bool) -> None:
        self._shines = on

    def _close(self) -> None:
        """Change nothing."""


class DrawnStage(Stage):
    """A stage without masks to choose from."""

    def __init__(self) -> None:
        super().__init__("square")
        self._name, self._holds_sample = "Drawn table", True

    def _is_sample_in(self) -> bool:
        return self._holds_sample

    def _set_sample_in(self, *, is_in: bool) -> None:
        self._holds_sample = is_in


def exposure_bench(
    scene: LampScene, *, exposure_s: float, current_a: float = _LIGHT.current_a, is_on: bool = False
) -> tuple[Devices, ManyFramesCamera, Lamp]:
    """The devices of a scene, then its camera and its lamp under their own types."""
    lamp = Lamp(scene.current_range_a, current_a, is_on=is_on)
    camera = ManyFramesCamera(scene, lamp, exposure_s)
    return Devices(camera, lamp, DrawnStage()), camera, lamp
