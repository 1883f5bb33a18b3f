"""Minimal bench for routines that run thousands of times: any range, any lamp, no waiting.

Frames are drawn, not propagated; light, noise, saturation and rounding are those of a camera.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import numpy as np

from drivers.interface import Camera, CameraCapabilities, Devices, Frame, LightSource, Range, Stage, WrongState
from reconstruction.arrays import Floats

PITCH_PX = 16.0
SIDE_PX = 160


def squares(width_px: float = 8.0, background: float = 0.0) -> Floats:
    """Smoothed subimages of a square source, (row, column), maximum 1."""
    position = np.abs((np.arange(SIDE_PX) + 0.5) % PITCH_PX - PITCH_PX / 2)
    profile = 1 / (1 + np.exp((position - width_px / 2) / 0.7))
    image = np.outer(profile, profile)
    return np.asarray(background + (1 - background) * image / image.max())


def spots(first_zero_px: float = 2.7, pitch_px: float = 16.25) -> Floats:
    """Diffraction images of points at all positions between the pixels, (row, column), maximum at most 1."""
    position = (np.arange(SIDE_PX) + pitch_px / 2) % pitch_px - pitch_px / 2
    profile = np.sinc(position / first_zero_px) ** 2
    return np.asarray(np.outer(profile, profile))


@dataclass(kw_only=True)
class Scene:
    """Light, camera and noise."""

    counts_per_a_s: float  # of the brightest pixel
    exposure_range_s: Range
    image: Floats = field(default_factory=squares)
    current_range_a: Range = Range(0.0, 1.0)
    droop: float = 1.0  # light ~ current to this power
    exposure_step_s: float = 1e-5
    bits: int = 16
    offset_counts: float = 500.0
    read_noise_counts: float = 6.4
    counts_per_electron: float = 1 / 5.8
    well_counts: float = 1e9
    ambient_counts_per_s: float = 0.0
    flicker: float = 0.0  # relative
    hot_pixels: int = 0
    cosmic_rays: int = 0  # in each frame
    seed: int = 1


class ManyFramesCamera:
    """A camera that returns a frame at once."""

    def __init__(self, scene: Scene, lamp: Lamp, exposure_s: float) -> None:
        self.scene, self.lamp, self.exposure_s = scene, lamp, exposure_s
        self.is_running, self.amplifier, self.em_gain, self.frames = False, "normal", 1.0, 0
        self.exposed_s: list[float] = []
        self.random = np.random.default_rng(scene.seed)
        self.hot = self.random.integers(0, SIDE_PX, (2, scene.hot_pixels))

    @property
    def capabilities(self) -> CameraCapabilities:
        """Capabilities of the camera."""
        return CameraCapabilities(
            rows=SIDE_PX,
            columns=SIDE_PX,
            pixel_pitch_m=16e-6,
            full_scale=2**self.scene.bits - 1,
            exposure_range_s=self.scene.exposure_range_s,
            amplifiers=("normal",),
            em_gain_range=Range(1.0, 1.0),
        )

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure, rounded to its step, and return it."""
        self.scene.exposure_range_s.check(exposure_s, "exposure_s")
        step_s = self.scene.exposure_step_s
        self.exposure_s = round(exposure_s / step_s) * step_s
        return self.exposure_s

    def start(self) -> None:
        """Start to acquire."""
        if self.is_running:
            raise WrongState("the camera is acquiring already")
        self.is_running, self.frames = True, 0

    def stop(self) -> None:
        """Stop acquiring."""
        self.is_running = False

    def read(self, timeout_s: float) -> Frame:
        """Return the next frame at once."""
        if not self.is_running or timeout_s <= 0:
            raise WrongState("the camera is not acquiring, or there is no time to wait for it")
        scene, random = self.scene, self.random
        light = scene.counts_per_a_s * self.lamp.current_a**scene.droop * self.lamp.is_on * self.exposure_s
        light *= 1 + scene.flicker * random.standard_normal()
        electrons = (scene.image * light + scene.ambient_counts_per_s * self.exposure_s) / scene.counts_per_electron
        noisy = electrons + np.sqrt(electrons) * random.standard_normal(electrons.shape)
        counts = np.clip(noisy * scene.counts_per_electron, 0, scene.well_counts)
        counts += scene.offset_counts + scene.read_noise_counts * random.standard_normal(counts.shape)
        counts[tuple(self.hot)] = 1e9
        row, column = random.integers(0, SIDE_PX - 8, (2, scene.cosmic_rays))
        for step in range(8):  # a track
            counts[row + step, column + step // 2] += 30_000
        pixels = np.clip(np.rint(counts), 0, 2**scene.bits - 1).astype(np.uint16)
        self.frames += 1
        self.exposed_s.append(self.exposure_s)
        return Frame(pixels, self.frames - 1, 0.0, 0.0, self.exposure_s, 1.0)


@dataclass
class Lamp:
    """A light without faults."""

    current_range_a: Range
    current_a: float
    is_on: bool

    def set_current(self, current_a: float) -> float:
        """Set the current and return it."""
        self.current_a = self.current_range_a.check(current_a, "current_a")
        return self.current_a

    def set_on(self, on: bool) -> None:
        """Switch the light."""
        self.is_on = on


@dataclass
class Table:
    """A stage without masks to choose from."""

    is_sample_in: bool = True
    mask: str = "square"

    def set_sample_in(self, sample_in: bool) -> None:
        """Move the sample."""
        self.is_sample_in = sample_in


def exposure_bench(
    scene: Scene, *, exposure_s: float, current_a: float = 0.35, is_on: bool = False
) -> tuple[Devices, ManyFramesCamera, Lamp]:
    """The devices of a scene, then its camera and its lamp under their own types."""
    lamp = Lamp(scene.current_range_a, current_a, is_on)
    camera = ManyFramesCamera(scene, lamp, exposure_s)
    return Devices(cast("Camera", camera), cast("LightSource", lamp), cast("Stage", Table())), camera, lamp
