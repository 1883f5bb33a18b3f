"""Reference and frame of each mask for the paper's tables."""

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from app.acquisition.devices import simulated_bench
from app.bench.config import Bench
from app.errors import InputError
from app.evaluation.noise_free import NoiseFreeFrames
from drivers.interface import BadValue
from reconstruction.arrays import Floats, Image
from reconstruction.geometry import nominal_lattice
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import ManualClock

Mask = Literal["square", "stars"]

_CROP, _RESIZED = 469, 465  # px; the paper's frames end with 31 pixels per lenslet
_DARKS = 8


@dataclass(frozen=True, slots=True, eq=False)
class FramePair:
    """Reference and frame of one mask, counts or photons above the dark, (row, column)."""

    reference: Image
    frame: Image


def noise_free_frames(bench: Bench, masks: tuple[str, ...]) -> tuple[dict[str, FramePair], Floats]:
    """Return mean photons of reference and frame for each mask, and the true wavefronts of the views."""
    rendered = NoiseFreeFrames(bench)
    with_sample = {mask: rendered.frame(mask) for mask in masks}
    frames = {mask: FramePair(rendered.reference(mask), frame.photons) for mask, frame in with_sample.items()}
    return frames, with_sample[masks[0]].truth


def exposed_frames(
    bench: Bench, exposures_s: Mapping[Mask, float], progress: Callable[[float], None]
) -> tuple[dict[str, FramePair], Floats]:
    """Return frames of the noisy camera above the dark for each mask and its exposure, and the true wavefronts."""
    frames: dict[str, FramePair] = {}
    with closing(simulated_bench(bench, progress, ManualClock())) as simulated, SimulatedCamera(simulated) as camera:
        for mask, exposure_s in exposures_s.items():
            try:
                camera.set_exposure(exposure_s)
            except BadValue as error:
                raise InputError(f"camera: the {mask} need another amplifier or readout_speed: {error}") from error
            simulated.change(mask=mask, is_light_on=False, is_sample_in=False)
            dark = np.mean([_photograph(camera) for _ in range(_DARKS)], axis=0)
            simulated.change(is_light_on=True)
            reference = _photograph(camera) - dark
            simulated.change(is_sample_in=True)
            frames[mask] = FramePair(reference.astype(np.float32), (_photograph(camera) - dark).astype(np.float32))
        return frames, simulated.truth_wavefront(0)


def _photograph(camera: SimulatedCamera) -> Image:
    camera.start()
    pixels = camera.read(2 * camera.exposure_s).pixels
    camera.stop()
    return pixels.astype(np.float32)


def resized(bench: Bench, frames: Mapping[str, FramePair]) -> tuple[Bench, dict[str, FramePair]]:
    """Crop the middle 469 x 469 pixels and resize them to 465 x 465, bicubically, as in the paper.

    Returns the bench with the geometry of the resized frames, and these.
    """
    sensor = replace(bench.sensor, pixel_pitch_m=bench.sensor.lenslet_pitch_m / 31)
    lattice = nominal_lattice(sensor, _RESIZED, _RESIZED)
    return replace(bench, sensor=sensor, lattice=lattice), {
        mask: FramePair(_crop_and_resize(pair.reference), _crop_and_resize(pair.frame)) for mask, pair in frames.items()
    }


def _crop_and_resize(image: Image) -> Image:
    top, left = ((length - _CROP) // 2 for length in image.shape)
    middle = image[top : top + _CROP, left : left + _CROP]
    return np.asarray(cv2.resize(middle, (_RESIZED, _RESIZED), interpolation=cv2.INTER_CUBIC), np.float32)
