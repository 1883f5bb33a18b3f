"""Correlation: tilts in closed form, and images that do not match."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import FIELD, SmallBench

from app.evaluation.paper.correlation import Correlation
from reconstruction.arrays import Image
from reconstruction.displacement import LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field
from reconstruction.reconstructor import OwnMethods
from reconstruction.registration.subimages import ReferenceSubimages

SHIFT_PX = (2.4, -1.3)
ALIKE_PX = 0.02


@pytest.fixture(scope="module")
def reference(small_bench: SmallBench) -> ReferenceSubimages:
    return ReferenceSubimages(
        small_bench.reference, sensor=small_bench.sensor, lattice=small_bench.lattice, field=FIELD
    )


@pytest.fixture(scope="module")
def shifted(small_bench: SmallBench) -> Image:
    """A frame displaced by a tilt of SHIFT_PX."""
    return _tilted(small_bench, *SHIFT_PX)


def _tilted(bench: SmallBench, x_px: float, y_px: float) -> Image:
    u, v = bench.samples()
    slope = bench.sensor.slope_per_px
    return bench.frame(lambda _x, _y: (slope * (x_px * u + y_px * v)).astype(np.float32))


def _none(light: Image) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    return np.zeros(light.shape, np.bool_)


@pytest.mark.parametrize("shift_px", [SHIFT_PX, (0.5, 0.0), (-0.25, 4.1), (-3.7, -3.6)])
def test_tilt_is_recovered_as_shift(
    small_bench: SmallBench, reference: ReferenceSubimages, shift_px: tuple[float, float]
) -> None:
    light = _tilted(small_bench, *shift_px)
    displacement = Correlation(reference, FIELD)(light, saturated=_none(light))
    assert displacement.valid.all()
    assert displacement.coefficients.shape == displacement.variance.shape == (7, 9, 1, 2)
    assert displacement.residual_rms.shape == (7, 9)
    assert np.abs(displacement.coefficients[:, :, 0] - shift_px).max() < ALIKE_PX


def test_displacement_that_varies_over_field_gives_mean_shift(
    small_bench: SmallBench, reference: ReferenceSubimages
) -> None:
    u, v = small_bench.samples()
    slope, half_m = small_bench.sensor.slope_per_px, FIELD.half_width_m
    light = small_bench.frame(
        lambda x, y: (slope * ((1.5 + 0.6 * x / half_m) * u + (0.7 - 0.5 * y / half_m) * v)).astype(np.float32)
    )
    displacement = Correlation(reference, FIELD)(light, saturated=_none(light))
    assert displacement.valid.all()
    np.testing.assert_allclose(displacement.mean, np.broadcast_to([1.5, 0.7], (7, 9, 2)), atol=0.03)


def test_dark_and_saturated_lenslets_are_lost(
    small_bench: SmallBench, reference: ReferenceSubimages, shifted: Image
) -> None:
    light, saturated = shifted.copy(), _none(shifted)
    dark_x, dark_y = np.rint(small_bench.lattice.lenslet_centers_px(7, 9)[2, 5]).astype(int)
    light[dark_y - 15 : dark_y + 16, dark_x - 15 : dark_x + 16] = 0
    bright_x, bright_y = np.rint(small_bench.lattice.lenslet_centers_px(7, 9)[4, 1]).astype(int)
    saturated[bright_y, bright_x] = True
    displacement = Correlation(reference, FIELD)(light, saturated=saturated)
    expected = np.full((7, 9), LensletStatus.CONVERGED)
    expected[2, 5], expected[4, 1] = LensletStatus.DARK, LensletStatus.SATURATED
    np.testing.assert_array_equal(displacement.outcome, expected)
    for values in (displacement.coefficients, displacement.variance, displacement.residual_rms):
        assert np.isnan(values[expected != LensletStatus.CONVERGED]).all()
        assert np.isfinite(values[expected == LensletStatus.CONVERGED]).all()


def test_shift_out_of_reach_or_foreign_image_is_lost(small_bench: SmallBench, reference: ReferenceSubimages) -> None:
    correlate = Correlation(reference, FIELD)
    far = _tilted(small_bench, 7.5, 0.0)
    assert not correlate(far, saturated=_none(far)).valid.any()
    noise = np.random.default_rng(1).normal(0, 1, far.shape).astype(np.float32)
    assert not correlate(noise, saturated=_none(noise)).valid.any()


def test_variance_matches_scatter_of_noisy_shifts(reference: ReferenceSubimages, shifted: Image) -> None:
    rng = np.random.default_rng(2)
    noisy = np.asarray(shifted + rng.normal(0, 0.05 * shifted.max(), shifted.shape), np.float32)
    correlate = Correlation(reference, FIELD)
    calm, restless = (correlate(light, saturated=_none(light)) for light in (shifted, noisy))
    scatter = np.var(restless.coefficients - calm.coefficients)
    assert 0.6 < scatter / restless.variance.mean() < 1.6
    assert restless.variance.mean() > 2 * calm.variance.mean()


def test_field_that_fills_the_cells_is_refused(small_bench: SmallBench) -> None:
    wide = Field(collimator_focal_length_m=0.2, half_width_m=0.95e-3)
    filled = ReferenceSubimages(
        small_bench.reference, sensor=small_bench.sensor, lattice=small_bench.lattice, field=wide
    )
    with pytest.raises(ReconstructionError, match="field fills the lenslets' cells"):
        Correlation(filled, wide)


def test_wavefront_of_a_tilt(small_bench: SmallBench, shifted: Image) -> None:
    wavefront = small_bench.reconstructor(own=OwnMethods(Correlation), pupil_modes=3)(shifted)
    slopes = np.array(SHIFT_PX) * small_bench.sensor.slope_per_px
    tilt = slopes[0] * small_bench.pupil_x_m + slopes[1] * small_bench.pupil_y_m
    np.testing.assert_allclose(wavefront.views, np.broadcast_to(tilt, wavefront.views.shape), atol=0.01 * np.ptp(tilt))
