"""Refusal of frames without a lattice of the sensor's pitch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from skimage import data
from support.lattice_frames import FRAME, SENSOR, draw, drawn, image_of, sensor_with

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.lattice.search import survey


def noise(seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(500, 8, FRAME)


def waves(along_x: float, along_y: float) -> Floats:
    y, x = np.indices(FRAME)
    return 1000 * (1 + np.cos(2 * np.pi * (along_x * x + along_y * y)))


def hexagonal() -> Floats:
    y, x = np.indices(FRAME)
    angle = np.pi / 3 * np.arange(3)
    waves_of = [np.cos(2 * np.pi * (np.cos(one) * x + np.sin(one) * y) / 29) for one in angle]
    return np.asarray(5000 + 1000 * np.sum(waves_of, axis=0))


def pitch_of(pitch_px: float) -> Floats:
    count, blur_px = int(512 / pitch_px), pitch_px / 25
    return draw(
        FRAME,
        center_px=(255.0, 255.0),
        pitch_px=pitch_px,
        rotation_rad=0.01,
        brightness=np.ones((count, count)),
        image_px=image_of("square", pitch_px, 0.3, blur_px),
        blur_px=blur_px,
    )


def two_kinds() -> Floats:
    """A lattice whose lenslets show vertical and horizontal bars in turn."""
    x, y = np.meshgrid(np.arange(15), np.arange(15))
    along_px = np.linspace(-11, 11, 15)
    level_px = np.stack([along_px, np.zeros(15)], axis=-1)

    def some(kind: int, image_px: Floats) -> Floats:
        brightness = ((x + y) % 2 == kind).astype(np.float64)
        return draw(
            FRAME, center_px=(255.0, 255.0), pitch_px=31.25, rotation_rad=0, brightness=brightness, image_px=image_px
        )

    return some(0, level_px) + some(1, level_px[:, ::-1])


def scattered() -> Floats:
    beside_px = np.random.default_rng(5).normal(0, 3.2, (15, 15, 2))
    return draw(
        FRAME,
        center_px=(255.0, 255.0),
        pitch_px=31.25,
        rotation_rad=0.0,
        brightness=np.ones((15, 15)),
        image_px=image_of("square", 31.25, 0.25, 1.2),
        beside_px=beside_px,
    )


def spot(width_px: float) -> Floats:
    y, x = np.indices(FRAME)
    return noise(1) + 1e4 * np.exp(-((x - 200) ** 2 + (y - 300) ** 2) / (2 * width_px**2))


def gradient() -> Floats:
    y, x = np.indices(FRAME)
    return np.asarray(3.0 * x + y, np.float64)


REFUSED: dict[str, tuple[Callable[[], NDArray[np.generic]], str]] = {
    "noise": (lambda: noise(0), "was the light on"),
    "dark counts": (lambda: np.rint(noise(2)).astype(np.uint16), "was the light on"),
    "constant": (lambda: np.full(FRAME, 700), "all its pixels are alike"),
    "zero": (lambda: np.zeros(FRAME), "all its pixels are alike"),
    "gradient": (gradient, "no lattice"),
    "rounded gradient": (lambda: np.rint(gradient() * 0.13), "no lattice"),
    "a spot": (lambda: spot(5), "was the light on"),
    "a large spot": (lambda: spot(60), "no lattice"),
    "two spots": (lambda: spot(5) + np.roll(spot(5), 31, axis=1), "no lattice"),
    "stripes": (lambda: waves(1 / 31.25, 0) + noise(3), "one direction only"),
    "clean stripes": (lambda: waves(0, 1 / 31.25), "one direction only"),
    "slanted stripes": (lambda: waves(0.03, 0.01), "one direction only"),
    "hexagons": (hexagonal, "hexagonal"),
    "half the pitch": (lambda: pitch_of(15.6), "it shows one of 15.6 px; check sensor.lenslet_pitch_m"),
    "twice the pitch": (lambda: pitch_of(62.5), "it shows one of 62.5 px; check sensor.lenslet_pitch_m"),
    "1.4 times the pitch": (lambda: pitch_of(44.0), "no lattice"),
    "two kinds of images": (two_kinds, "its cells do not show the same image"),
    "images far from their places": (scattered, r"spots deviate from a square lattice by \d+ % of the pitch"),
    "a photographer": (data.camera, "no lattice"),
    "bricks": (data.brick, "no lattice"),
    "gravel": (data.gravel, "no lattice"),
    "clouds": (lambda: ndimage.gaussian_filter(noise(4), 8), "no lattice"),
    "too few": (lambda: drawn(brightness=np.pad(np.ones((3, 3)), 6)), "no lattice"),
    "not a number": (lambda: np.where(np.indices(FRAME)[0] == 7, np.nan, drawn()), "not finite"),
    "infinite": (lambda: np.where(np.indices(FRAME)[0] == 7, np.inf, drawn()), "not finite"),
    "tiny": (lambda: np.ones((3, 3)), "fit on 3 x 3 pixels"),
    "empty": (lambda: np.zeros((0, 512)), "not an image"),
    "a line": (lambda: np.zeros(512), "not an image"),
    "colours": (lambda: np.zeros((512, 512, 3)), "not an image"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_non_lattice_is_refused_with_reason(name: str) -> None:
    make, sentence = REFUSED[name]
    with pytest.raises(ReconstructionError, match=sentence) as refusal:
        survey(make(), SENSOR)  # type: ignore[arg-type] # some are not images
    assert refusal.value.image in {"reference", "dark"}
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("scatter", [0.0, 1.0])
def test_dark_with_light_is_blamed(scatter: float) -> None:
    light = 1000 * drawn()
    with pytest.raises(ReconstructionError, match="the dark shows the same light as the reference") as refusal:
        survey(light + scatter * noise(1), SENSOR, dark=light)
    assert refusal.value.image == "dark"


@pytest.mark.slow
def test_dark_without_light_is_not_blamed() -> None:
    """An uneven offset and hot pixels are in both images."""
    dark = 500 + gradient() / 50 + np.where(np.random.default_rng(6).random(FRAME) < 1e-3, 5e4, 0)
    for light in (noise(0), waves(1 / 31.25, 0) + noise(3)):
        with pytest.raises(ReconstructionError) as refusal:
            survey(dark + light, SENSOR, dark=dark)
        assert refusal.value.image == "reference"


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 12))
def test_noise_is_never_a_lattice(seed: int, count: int) -> None:
    frame = np.random.default_rng(seed).normal(500, 8, (int(count * 31.25) + 9,) * 2)
    with pytest.raises(ReconstructionError):
        survey(frame, sensor_with(count, count, 31.25))


def test_saturated_and_mismatched_frames_are_refused() -> None:
    light = np.minimum(drawn() * 9e4, 65535).astype(np.uint16)
    with pytest.raises(ReconstructionError, match="saturated"):
        survey(light, SENSOR, full_scale=65535)
    with pytest.raises(ReconstructionError, match="another size") as refusal:
        survey(light, SENSOR, dark=light[:100])
    assert refusal.value.image == "dark"
