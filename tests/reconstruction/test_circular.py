"""Circular pupils and fields in Zernike modes."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import FIELD, SmallBench, converged, sensor_of

from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.modes.field_modes import ZernikeModes
from reconstruction.modes.polynomials import zernike
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.reconstructor import Reconstructor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from reconstruction.solve.expected_errors import MeanGradients
from reconstruction.solve.modal import ModalSolver
from reconstruction.wavefront import rms

CIRCLE = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, shape="circle", view_spacing_m=0.4e-3)


def test_zernike_coefficients_are_recovered() -> None:
    sensor = sensor_of(11, 13)
    modes = pupil_modes(sensor, "zernike", 15)
    coefficients = np.random.default_rng(0).normal(size=(15, 2))
    coefficients[0] = 0  # slopes show no piston
    px = np.einsum("prcv,pq->rcqv", modes.gradients, coefficients) / sensor.slope_per_px
    px[~modes.inside] = 1e9  # outside the pupil
    displacement = converged(ZernikeModes(2), px, np.full_like(px, 1e-4))
    solver = ModalSolver(modes, MeanGradients(sensor, np.eye(4)), np.eye(4), displacement.covariance)
    solution = solver(displacement)
    np.testing.assert_allclose(solution.coefficients, coefficients, atol=1e-5)
    assert solution.chi_square < 1e-3  # lenslets outside do not count
    wavefront = solution.wavefront(np.array([1.0, 0.0]))
    assert np.array_equal(np.isfinite(wavefront), modes.inside)
    radius_m = 5.5 * 0.5e-3
    expected = np.tensordot(
        coefficients[:, 0], zernike(15, sensor.pupil_x_m / radius_m, sensor.pupil_y_m[:, None] / radius_m), axes=1
    )
    expected = np.where(modes.inside, expected, np.nan)
    np.testing.assert_allclose(wavefront, expected - np.nanmean(expected), atol=1e-5)


def test_circular_pupil_is_inscribed_in_lattice() -> None:
    inside = pupil_modes(sensor_of(5, 9), "zernike", 3).inside
    assert not inside[:, :2].any()
    assert inside[2].tolist() == [False, False, True, True, True, True, True, False, False]
    assert not inside[0, 2]


@pytest.fixture(scope="module")
def seen_by_a_circle(small_bench: SmallBench) -> tuple[Floats, Floats]:
    """Views measured with Zernike bases in pupil and field, and the truth."""

    def phase(u: Floats, v: Floats, x: float, y: float) -> Floats:
        return 2e5 * (u**2 - v**2) + 800.0 * (u * (x - y) - v * x) / FIELD.half_width_m

    u, v = small_bench.samples()
    frame = small_bench.frame(lambda x, y: phase(u, v, x, y).astype(np.float32))
    reconstructor = Reconstructor(
        small_bench.reference,
        sensor=small_bench.sensor,
        lattice=small_bench.lattice,
        field=CIRCLE,
        registration=RegistrationSettings(warp="affine"),
        reconstruction=ReconstructionSettings(basis="zernike", pupil_modes=10),
    )
    views = reconstructor(frame).views
    truth = np.array(
        [[phase(small_bench.pupil_x_m, small_bench.pupil_y_m, x, y) for x in CIRCLE.view_x_m] for y in CIRCLE.view_y_m]
    )
    return views, np.where(np.isfinite(views), truth, np.nan)


def test_space_variant_zernike_wavefront_is_recovered(seen_by_a_circle: tuple[Floats, Floats]) -> None:
    views, truth = seen_by_a_circle
    assert np.nanmax(rms(views - truth)) < 0.06 * np.nanmax(rms(truth))


def test_views_outside_circular_field_are_unknown(small_bench: SmallBench) -> None:
    far = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, shape="circle", view_spacing_m=0.5e-3)
    reconstructor = Reconstructor(
        small_bench.reference,
        sensor=small_bench.sensor,
        lattice=small_bench.lattice,
        field=far,
        registration=RegistrationSettings(warp="affine"),
        reconstruction=ReconstructionSettings(pupil_modes=10),
    )
    wavefront = reconstructor(small_bench.reference)
    known = np.isfinite(wavefront.views).all(axis=(2, 3))
    assert known.tolist() == [[False, True, False], [True, True, True], [False, True, False]]
    with pytest.raises(ValueError, match="outside the field"):
        wavefront.at(0.5e-3, 0.5e-3)
