"""Registration up to and beyond the dynamic range."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import FIELD, SmallBench, phase_only

from reconstruction.arrays import Image
from reconstruction.displacement import LensletStatus, RegistrationMethod
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.registration.gauss_newton import GaussNewton
from reconstruction.registration.subimages import ReferenceSubimages
from simulated_devices.optics.source import stars
from simulated_devices.settings import Source

RANGE_PX = (
    31.25 - 462e-9 * 46.7e-3 / 500e-6 / 16e-6
) / 2 - 0.6e-3 * 46.7e-3 / 0.2 / 16e-6  # half of pitch minus blur, minus the field


@pytest.fixture(scope="module")
def bench() -> SmallBench:
    return SmallBench(4, 5)


@pytest.fixture(scope="module")
def estimate(bench: SmallBench) -> RegistrationMethod:
    return GaussNewton(bench.subimages(), LegendreModes(6), conserve_flux=True, may_rotate=True)


def _tilted(bench: SmallBench, x_px: float, y_px: float) -> Image:
    u, v = bench.samples()
    slope = bench.sensor.slope_per_px
    return bench.frame(lambda _x, _y: (slope * (x_px * u + y_px * v)).astype(np.float32))


def _every_lenslet_its_own(bench: SmallBench, shift_px: float) -> Image:
    """A frame whose neighbouring lenslets are displaced by opposite shifts, +-shift_px along x and y."""
    u, v = bench.samples()
    pitch, slope = bench.sensor.lenslet_pitch_m, bench.sensor.slope_per_px * shift_px
    x, y = np.rint(u / pitch), np.rint(v / pitch - 0.5) + 0.5
    sign_x, sign_y = np.where(np.mod(x, 2) == 0, 1, -1), np.where(np.mod(y - 0.5, 2) == 0, 1, -1)
    tilt = slope * (sign_x * (u - x * pitch) + sign_y * (v - y * pitch))
    return bench.frame(lambda _x, _y: tilt.astype(np.float32))


def _still(bench: SmallBench) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    return np.zeros(bench.frame_shape, np.bool_)


@pytest.mark.parametrize(
    "shift_px", [(5.4, 0.0), (0.0, -5.4), (5.4, 5.4), (-5.3, 5.2), (-5.4, -5.4), (4.7, -3.6), (-2.5, 5.4)]
)
def test_tilts_up_to_cell_edge_are_recovered(
    bench: SmallBench, estimate: RegistrationMethod, shift_px: tuple[float, float]
) -> None:
    displacement = estimate(_tilted(bench, *shift_px), saturated=_still(bench))
    assert displacement.valid.all()
    assert np.abs(displacement.coefficients[:, :, 0] - shift_px).max() < 0.02
    assert np.abs(displacement.coefficients[:, :, 1:]).max() < 0.05
    np.testing.assert_allclose(displacement.range_used, np.abs(shift_px).max() / RANGE_PX, atol=0.015)


def test_lenslet_beyond_range_is_lost_with_range_used(bench: SmallBench, estimate: RegistrationMethod) -> None:
    displacement = estimate(_tilted(bench, 6.2, 0.0), saturated=_still(bench))
    assert set(displacement.outcome.ravel()) <= {LensletStatus.LEFT_CELL, LensletStatus.DIVERGED}
    assert np.count_nonzero(displacement.outcome == LensletStatus.LEFT_CELL) > 15
    assert np.isnan(displacement.coefficients).all()
    left = displacement.range_used[displacement.outcome == LensletStatus.LEFT_CELL]
    np.testing.assert_allclose(left, 6.2 / RANGE_PX, atol=0.05)


@pytest.mark.parametrize("shift_px", [4.5, 5.3])
def test_light_of_close_neighbour_has_no_weight(
    bench: SmallBench, estimate: RegistrationMethod, shift_px: float
) -> None:
    displacement = estimate(_every_lenslet_its_own(bench, shift_px), saturated=_still(bench))
    assert displacement.valid.all()
    sign_x, sign_y = np.array([1, -1, 1, -1, 1]), np.array([1, -1, 1, -1])[:, None]
    expected = np.stack(np.broadcast_arrays(sign_x, sign_y), axis=-1) * shift_px
    assert np.abs(displacement.coefficients[:, :, 0] - expected).max() < 0.02
    assert np.abs(displacement.coefficients[:, :, 1:]).max() < 0.05


@pytest.mark.parametrize("shift_px", [(3.0, 0.0), (4.6, -4.2), (-5.3, 5.3)])
def test_stars_displaced_by_more_than_their_size_are_recovered(
    bench: SmallBench, shift_px: tuple[float, float]
) -> None:
    source = stars(Source())
    u, v = bench.samples()
    slope = bench.sensor.slope_per_px
    tilt = (slope * (shift_px[0] * u + shift_px[1] * v)).astype(np.float32)
    reference, light = (
        bench.model.irradiance(source, field) * np.float32(1e14) for field in (None, phase_only(lambda _x, _y: tilt))
    )
    subimages = ReferenceSubimages(reference, sensor=bench.sensor, lattice=bench.lattice, field=FIELD)
    method = GaussNewton(subimages, LegendreModes(3), conserve_flux=True, may_rotate=True)
    displacement = method(light, saturated=_still(bench))
    assert displacement.valid.all()
    assert np.abs(displacement.coefficients[:, :, 0] - shift_px).max() < 0.03


def test_noisy_frame_near_range_limit_is_recovered(bench: SmallBench, estimate: RegistrationMethod) -> None:
    light = _tilted(bench, -5.0, 4.8)
    rng = np.random.default_rng(0)
    noisy = np.asarray(light + rng.normal(0, 0.08 * light.max(), light.shape), np.float32)
    displacement = estimate(noisy, saturated=_still(bench))
    assert displacement.valid.mean() > 0.9
    mean = displacement.coefficients[displacement.valid][:, 0].mean(axis=0)
    np.testing.assert_allclose(mean, (-5.0, 4.8), atol=0.1)
