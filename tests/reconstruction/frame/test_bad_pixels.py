"""Bad-pixel detection and repair."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
from support.optics import SmallBench
from support.paths import FOREIGN_FRAMES

from reconstruction.arrays import Floats, Image
from reconstruction.frame.bad_pixels import find_bad_pixels, repaired
from simulated_devices.optics.source import source_points, stars
from simulated_devices.settings import Source

FRAMES = FOREIGN_FRAMES
BLUR_PX = SmallBench().sensor.blur_px
SOURCES = {"square": source_points("square", Source(), object_samples=19), "stars": stars(Source())}


@pytest.fixture(scope="module", params=SOURCES)
def light(request: pytest.FixtureRequest, small_bench: SmallBench) -> Image:
    """A reference with one as its brightest pixel."""
    image = small_bench.model.irradiance(SOURCES[request.param])
    return np.asarray(image / image.max(), np.float32)


@pytest.mark.parametrize("name", ["square_reference.tif", "square_frame.tif"])
def test_frames_of_another_simulator_have_no_bad_pixels(name: str) -> None:
    assert not find_bad_pixels(tifffile.imread(FRAMES / name), blur_px=BLUR_PX).any()


@pytest.mark.parametrize("electrons", [10.0, 100.0, 10000.0])
@pytest.mark.parametrize("frames", [1, 30])
def test_noise_is_not_taken_for_bad_pixels(light: Image, electrons: float, frames: int) -> None:
    rng = np.random.default_rng(0)
    signal = np.maximum(light.astype(np.float64), 0) * electrons

    def exposed(signal: Floats) -> Image:
        """Mean of frames with electron multiplication: a gamma-distributed count per electron."""
        draws = [rng.gamma(np.maximum(rng.poisson(signal + 0.02), 1e-9), 20.0) for _ in range(frames)]
        return np.asarray(np.mean(draws, axis=0) + rng.normal(0, 4 / np.sqrt(frames), signal.shape) + 500, np.float32)

    dark = exposed(np.zeros_like(signal))
    assert not find_bad_pixels(exposed(signal), dark, blur_px=BLUR_PX).any()
    assert not find_bad_pixels(exposed(signal), blur_px=BLUR_PX).any()


def test_dead_and_hot_pixels_are_found(small_bench: SmallBench) -> None:
    image = small_bench.reference * np.float32(10000 / small_bench.reference.max())
    rng = np.random.default_rng(1)
    x, y = np.rint(small_bench.lattice.lenslet_centers_px(7, 9)).astype(int).reshape(-1, 2).T
    put = np.zeros(image.shape, np.bool_)
    put[y + rng.integers(-5, 6, y.size), x + rng.integers(-5, 6, x.size)] = True
    dead = np.where(put, 0, image)
    noisy = rng.poisson(np.maximum(dead, 0)) + rng.normal(300, 8, image.shape)
    np.testing.assert_array_equal(find_bad_pixels(noisy, blur_px=BLUR_PX), put)
    hot = np.where(put, 0, image)
    dark = rng.normal(300, 8, image.shape) + 2000 * put
    np.testing.assert_array_equal(find_bad_pixels(rng.poisson(np.maximum(hot, 0)) + dark, dark, blur_px=BLUR_PX), put)


def test_hot_pixel_in_dark_part_of_reference_is_found(small_bench: SmallBench) -> None:
    rng = np.random.default_rng(2)
    image = small_bench.reference * np.float32(1000 / small_bench.reference.max())
    corner = np.rint(small_bench.lattice.lenslet_centers_px(7, 9)[3, 3] + 15).astype(int)
    noisy = rng.poisson(np.maximum(image, 0)) + rng.normal(300, 8, image.shape)
    noisy[corner[1], corner[0]] += 2500
    assert np.argwhere(find_bad_pixels(noisy, blur_px=BLUR_PX)).tolist() == [[corner[1], corner[0]]]


def test_dark_frame_has_no_bad_pixels() -> None:
    assert not find_bad_pixels(np.full((40, 50), 7, np.uint16), blur_px=BLUR_PX).any()
    assert not find_bad_pixels(np.zeros((40, 50)), blur_px=BLUR_PX).any()


def test_repair_preserves_a_plane() -> None:
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:30, :40].astype(np.float32)
    plane = 3 * x - 2 * y + 100
    bad = np.zeros(plane.shape, np.bool_)
    bad[2:-2:5, 3:-3:7] = True
    spoilt = np.where(bad, rng.uniform(-1e6, 1e6, plane.shape), plane).astype(np.float32)
    copy = spoilt.copy()
    np.testing.assert_allclose(repaired(spoilt, bad), plane, rtol=1e-5)
    np.testing.assert_array_equal(spoilt, copy)
    assert repaired(plane, np.zeros_like(bad)) is plane
    assert np.isfinite(repaired(spoilt, np.ones_like(bad))).all()
    bad[10:16, 10:16] = True
    assert np.abs(repaired(np.where(bad, 1e9, plane).astype(np.float32), bad) - plane).max() < 15


@pytest.mark.parametrize("stale_dark", [False, True])
@pytest.mark.parametrize("height", [0.3, 2.0])
def test_what_stays_on_the_sensor_is_found(small_bench: SmallBench, height: float, *, stale_dark: bool) -> None:
    """Pixels that are hot in reference and frames, and in the dark not at all, or others there."""
    peak, rng = 1e4, np.random.default_rng(4)
    image = small_bench.reference * np.float32(peak / small_bench.reference.max())
    hot, of_dark = (rng.random(image.shape) < 0.005 for _ in range(2))
    reference = rng.poisson(np.maximum(image, 0)) + height * peak * hot + 300.0
    dark = rng.normal(300, 3, image.shape) + height * peak * (of_dark & stale_dark)
    found = find_bad_pixels(reference, dark, blur_px=BLUR_PX)
    spoilt = hot ^ (of_dark & stale_dark)
    assert np.mean(found[spoilt]) > 0.95
    assert np.mean(found[~spoilt]) < 0.03  # some neighbours of strong ones
