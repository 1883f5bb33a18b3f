"""Centroids of stars: known tilts through the forward model, and lost stars."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.optics import FIELD, SmallBench, phase_only

from reconstruction.arrays import Booleans, Image
from reconstruction.displacement import Displacement, LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import SampledModes
from reconstruction.registration import prepare_registration
from reconstruction.registration.centroids import Centroids
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings
from simulated_devices.optics.source import stars
from simulated_devices.settings import Source

STAR_X = np.array([-1.0, 0.0, 1.0]) * 0.5 / 0.6
STAR_Y = np.array([-0.5, 0.5]) * 0.5 / 0.6  # two rows of three, to detect swapped rows and columns
SOURCE = stars(Source(star_rows=2, star_columns=3))
SHIFT_PX = (2.4, -1.3)
Shift = Callable[[float, float], tuple[float, float]]  # of the normalised field position


def _moved(bench: SmallBench, shift_px: Shift) -> Image:
    """The stars, each displaced by its own tilt."""
    u, v = bench.samples()
    slope, half_m = bench.sensor.slope_per_px, FIELD.half_width_m

    def phase(x_m: float, y_m: float) -> Image:
        x_px, y_px = shift_px(x_m / half_m, y_m / half_m)
        return np.asarray(slope * (x_px * u + y_px * v), np.float32)

    return bench.model.irradiance(SOURCE, phase_only(phase)) * np.float32(1e14)


def _none(light: Image) -> Booleans:
    return np.zeros(light.shape, np.bool_)


def _star_px(bench: SmallBench, row: int, column: int, star: int) -> tuple[int, int]:
    """Nearest pixel (row, column) to a star in the reference."""
    x, y = SampledModes(STAR_X, STAR_Y).nodes
    half_px = FIELD.half_width_px(bench.sensor)
    local = (np.array([column, row]) - [4, 3]) * bench.lattice.pitch_px + np.array([x[star], y[star]]) * half_px
    x_px, y_px = np.rint(bench.lattice.to_camera_px(local)).astype(int)
    return int(y_px), int(x_px)


@pytest.fixture(scope="module")
def still(small_bench: SmallBench) -> Image:
    return small_bench.model.irradiance(SOURCE) * np.float32(1e14)


@pytest.fixture(scope="module")
def reference(small_bench: SmallBench, still: Image) -> ReferenceSubimages:
    return ReferenceSubimages(still, sensor=small_bench.sensor, lattice=small_bench.lattice, field=FIELD)


@pytest.fixture(scope="module")
def centroids(reference: ReferenceSubimages) -> Centroids:
    return Centroids(reference, star_x=STAR_X, star_y=STAR_Y)


@pytest.fixture(scope="module")
def shifted(small_bench: SmallBench) -> Image:
    return _moved(small_bench, lambda _x, _y: SHIFT_PX)


@pytest.mark.parametrize("shift_px", [SHIFT_PX, (0.5, 0.0), (-0.25, 4.1), (-3.7, -3.6)])
def test_tilt_shifts_every_star(small_bench: SmallBench, centroids: Centroids, shift_px: tuple[float, float]) -> None:
    light = _moved(small_bench, lambda _x, _y: shift_px)
    displacement = centroids(light, saturated=_none(light))
    assert displacement.valid.all()
    assert displacement.coefficients.shape == displacement.variance.shape == (7, 9, 6, 2)
    assert displacement.residual_rms.shape == (7, 9)
    assert np.abs(displacement.coefficients - shift_px).max() < 0.01


def test_each_star_is_displaced_independently(small_bench: SmallBench, centroids: Centroids) -> None:
    def shift_px(x: float, y: float) -> tuple[float, float]:
        return 1.5 + 0.8 * x - 0.3 * y, -0.7 + 0.5 * x + 0.9 * y

    light = _moved(small_bench, shift_px)
    displacement = centroids(light, saturated=_none(light))
    assert displacement.valid.all()
    expected = np.stack([shift_px(x, y) for x, y in zip(*SampledModes(STAR_X, STAR_Y).nodes, strict=True)])
    assert np.abs(displacement.coefficients - expected).max() < 0.02
    assert np.abs(displacement.mean - [1.5, -0.7]).max() < 0.02


def _only_lost(displacement: Displacement, row: int, column: int, outcomes: set[LensletStatus]) -> None:
    valid = np.ones((7, 9), np.bool_)
    valid[row, column] = False
    np.testing.assert_array_equal(displacement.valid, valid)
    assert displacement.outcome[row, column] in outcomes
    for values in (displacement.coefficients, displacement.variance, displacement.residual_rms):
        assert np.isnan(values[row, column]).all()
        assert np.isfinite(values[valid]).all()


@pytest.mark.parametrize("star", range(6))
def test_lenslet_without_one_star_is_lost(
    small_bench: SmallBench, centroids: Centroids, still: Image, star: int
) -> None:
    light = still.copy()
    y, x = _star_px(small_bench, 2, 5, star)
    light[y - 3 : y + 4, x - 3 : x + 4] = 0
    _only_lost(centroids(light, saturated=_none(light)), 2, 5, {LensletStatus.DARK, LensletStatus.DIVERGED})


def test_saturated_star_is_lost(small_bench: SmallBench, centroids: Centroids, still: Image) -> None:
    saturated = _none(still)
    saturated[_star_px(small_bench, 4, 1, 2)] = True
    _only_lost(centroids(still, saturated=saturated), 4, 1, {LensletStatus.SATURATED})


def test_star_missing_in_reference_loses_its_lenslet(small_bench: SmallBench, still: Image) -> None:
    dusty = still.copy()
    y, x = _star_px(small_bench, 3, 6, 4)
    dusty[y - 3 : y + 4, x - 3 : x + 4] = 0
    reference = ReferenceSubimages(dusty, sensor=small_bench.sensor, lattice=small_bench.lattice, field=FIELD)
    displacement = Centroids(reference, star_x=STAR_X, star_y=STAR_Y)(still, saturated=_none(still))
    _only_lost(displacement, 3, 6, {LensletStatus.DARK, LensletStatus.DIVERGED})


def test_star_displaced_towards_neighbour_is_lost(small_bench: SmallBench, centroids: Centroids) -> None:
    light = _moved(small_bench, lambda x, _y: (5.5 if x > 0.5 else 0.0, 0.0))
    assert not centroids(light, saturated=_none(light)).valid.any()


def test_stars_that_blur_into_each_other_are_refused(paper_bench: SmallBench) -> None:
    reference = ReferenceSubimages(
        paper_bench.reference, sensor=paper_bench.sensor, lattice=paper_bench.lattice, field=FIELD
    )
    settings = RegistrationSettings(method="centroids", star_spacing_m=1e-5)
    with pytest.raises(ReconstructionError, match=r"star_spacing_m does not suit the lenslets: stars must"):
        prepare_registration(reference, settings, FIELD)


def test_noise_is_not_taken_for_stars(centroids: Centroids, still: Image) -> None:
    noise = np.random.default_rng(1).normal(0, 1, still.shape).astype(np.float32)
    assert not centroids(noise, saturated=_none(noise)).valid.any()


def test_variance_matches_scatter_of_noisy_shifts(centroids: Centroids, shifted: Image) -> None:
    rng = np.random.default_rng(2)
    noisy = np.asarray(shifted + rng.normal(0, 0.04 * shifted.max(), shifted.shape), np.float32)
    calm, restless = (centroids(light, saturated=_none(light)) for light in (shifted, noisy))
    both = calm.valid & restless.valid
    assert both.mean() > 0.9
    scatter = np.var((restless.coefficients - calm.coefficients)[both])
    assert 0.5 < scatter / restless.variance[both].mean() < 2


def test_invalid_arguments_are_refused(small_bench: SmallBench, reference: ReferenceSubimages) -> None:
    nonsense = {"must lie in the field": np.array([0.0, 1.4]), "apart": np.array([0.0, 0.1])}
    for sentence, star_x in nonsense.items():
        with pytest.raises(ValueError, match=sentence):
            Centroids(reference, star_x=star_x, star_y=STAR_Y)
    with pytest.raises(ReconstructionError, match="no stars where they are expected"):
        Centroids(
            ReferenceSubimages(
                small_bench.reference, sensor=small_bench.sensor, lattice=small_bench.lattice, field=FIELD
            ),
            star_x=STAR_X,
            star_y=STAR_X,
        )
    with pytest.raises(ReconstructionError, match="no stars where they are expected"):
        Centroids(reference, star_x=STAR_X, star_y=STAR_X)


def test_settings_choose_the_method(
    small_bench: SmallBench, reference: ReferenceSubimages, still: Image, shifted: Image
) -> None:
    settings = RegistrationSettings(method="centroids", star_rows=2)
    assert isinstance(prepare_registration(reference, settings, FIELD), Centroids)
    wavefront = small_bench.reconstructor(method="zonal", reference=still, registration=settings)(shifted)
    slopes = np.array(SHIFT_PX) * small_bench.sensor.slope_per_px
    tilt = slopes[0] * small_bench.pupil_x_m + slopes[1] * small_bench.pupil_y_m
    np.testing.assert_allclose(wavefront.views, np.broadcast_to(tilt, wavefront.views.shape), atol=0.02 * np.ptp(tilt))
