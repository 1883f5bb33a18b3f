"""Registration with dead and saturated pixels."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.optics import SmallBench

from reconstruction.arrays import Booleans, Image
from reconstruction.displacement import Displacement, LensletStatus
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.registration import prepare_registration
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import Method, RegistrationSettings

PEAK_ELECTRONS, READ_NOISE = 3000.0, 8.0
CENTER = (4, 1)  # the lenslet whose pixels are bad


def _electrons(bench: SmallBench) -> tuple[Image, Image]:
    """Reference and a sheared frame, in electrons."""
    u, v = bench.samples()
    frame = bench.frame(lambda x, _y: (1500.0 * u + 500.0 * v + 4e5 * u * x).astype(np.float32))
    scale = np.float32(PEAK_ELECTRONS / bench.reference.max())
    return bench.reference * scale, frame * scale


@pytest.fixture(scope="module")
def electrons(checker_bench: SmallBench) -> tuple[Image, Image]:
    return _electrons(checker_bench)


def _pixels(bench: SmallBench, offsets: list[tuple[int, int]]) -> Booleans:
    """True at (x, y) offsets from the middle of the lenslet CENTER."""
    mask = np.zeros(bench.frame_shape, np.bool_)
    x, y = np.rint(bench.lattice.lenslet_centers_px(7, 9)[CENTER]).astype(int)
    for right, down in offsets:
        mask[y + down, x + right] = True
    return mask


def _register(
    bench: SmallBench,
    reference: Image,
    light: Image,
    *,
    bad: Booleans | None = None,
    saturated: Booleans | None = None,
    method: Method = "gauss_newton",
) -> Displacement:
    subimages = ReferenceSubimages(
        reference,
        sensor=bench.sensor,
        lattice=bench.lattice,
        field=bench.field,
        noise=KnownNoise(CameraNoise(1.0, READ_NOISE)),
        bad=bad,
    )
    estimate = prepare_registration(subimages, RegistrationSettings(method=method), bench.field)
    return estimate(light, saturated=np.zeros(light.shape, np.bool_) if saturated is None else saturated)


SPOTS: dict[str, list[tuple[int, int]]] = {
    "one": [(7, 3)],
    "a column": [(8, y) for y in range(-2, 3)],
    "a cluster": [(x, y) for x in (-9, -8, -7) for y in (-3, -2, -1)],
}


@pytest.mark.parametrize("kind", ["saturated", "dead"])
@pytest.mark.parametrize("name", SPOTS)
def test_lenslet_is_registered_without_its_bad_pixels(
    checker_bench: SmallBench, electrons: tuple[Image, Image], name: str, kind: str
) -> None:
    reference, light = electrons
    bad = _pixels(checker_bench, SPOTS[name])
    clean = _register(checker_bench, reference, light)
    rng = np.random.default_rng(0)
    spoilt = light.copy()
    spoilt[bad] = rng.uniform(-1, 5, np.count_nonzero(bad)) * PEAK_ELECTRONS
    if kind == "saturated":
        found = _register(checker_bench, reference, spoilt, saturated=bad)
    else:
        dead = reference.copy()
        dead[bad] = 0.0
        found = _register(checker_bench, dead, spoilt, bad=bad)
    assert found.valid.all()
    others = np.ones((7, 9), np.bool_)
    others[CENTER] = False
    np.testing.assert_allclose(found.coefficients[others], clean.coefficients[others], atol=2e-3)
    sigma = np.sqrt(found.variance[CENTER])
    assert np.abs(found.coefficients[CENTER] - clean.coefficients[CENTER]).max() < max(3 * sigma.max(), 0.02)
    assert np.all(found.variance[CENTER] > 0.98 * clean.variance[CENTER])
    if name != "one":
        assert np.max(found.variance[CENTER] / clean.variance[CENTER]) > 1.05


def test_value_of_bad_pixel_does_not_matter(checker_bench: SmallBench, electrons: tuple[Image, Image]) -> None:
    reference, light = electrons
    bad = _pixels(checker_bench, SPOTS["a cluster"])
    results = []
    for value in (0.0, 1e4, -3e7):
        spoilt = light.copy()
        spoilt[bad] = value
        results.append(_register(checker_bench, reference, spoilt, saturated=bad).coefficients)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


@pytest.mark.parametrize("kind", ["saturated", "dead"])
def test_scatter_with_excluded_pixels_matches_covariance(
    checker_bench: SmallBench, electrons: tuple[Image, Image], kind: str
) -> None:
    reference, light = electrons
    offsets = [(x, y) for x in (7, 8, 9) for y in range(-9, 10, 5)] + SPOTS["a cluster"]
    bad = _pixels(checker_bench, offsets)
    saturated = bad if kind == "saturated" else None
    known = bad if kind == "dead" else None
    subimages = ReferenceSubimages(
        reference,
        sensor=checker_bench.sensor,
        lattice=checker_bench.lattice,
        field=checker_bench.field,
        noise=KnownNoise(CameraNoise(1.0, READ_NOISE)),
        bad=known,
    )
    estimate = prepare_registration(subimages, RegistrationSettings(), checker_bench.field)
    nowhere: NDArray[np.bool_] = np.zeros(light.shape, np.bool_)
    rng = np.random.default_rng(1)

    def draw(scale: float) -> Displacement:
        frame = np.asarray(light + scale * rng.normal(0, np.sqrt(np.maximum(light, 0) + READ_NOISE**2)), np.float32)
        frame[bad] = PEAK_ELECTRONS
        return estimate(frame, saturated=nowhere if saturated is None else saturated)

    still = draw(0.0)
    noisy = [draw(1.0) for _ in range(150)]
    error = np.array([frame.coefficients[CENTER] - still.coefficients[CENTER] for frame in noisy])
    sigma = np.sqrt(np.array([frame.variance[CENTER] for frame in noisy]))
    assert np.sqrt(np.mean((error / sigma) ** 2)) == pytest.approx(1.0, abs=0.1)
    assert np.mean(np.abs(error) < sigma) == pytest.approx(0.683, abs=0.05)
    chi_square = np.array([frame.chi_square[CENTER] for frame in noisy])
    assert chi_square.mean() - still.chi_square[CENTER] == pytest.approx(1.0, abs=0.1)


def test_lenslet_with_too_many_bad_pixels_is_lost(checker_bench: SmallBench, electrons: tuple[Image, Image]) -> None:
    reference, light = electrons
    half = _pixels(checker_bench, [(x, y) for x in range(13) for y in range(-12, 13)])
    found = _register(
        checker_bench, reference, np.where(half, PEAK_ELECTRONS, light).astype(np.float32), saturated=half
    )
    expected = np.zeros((7, 9), np.int8)
    expected[CENTER] = LensletStatus.SATURATED
    np.testing.assert_array_equal(found.outcome, expected)
    assert np.isnan(found.covariance[CENTER]).all()
    dead = _register(checker_bench, np.where(half, 0, reference).astype(np.float32), light, bad=half)
    expected[CENTER] = LensletStatus.DARK
    np.testing.assert_array_equal(dead.outcome, expected)
