"""Covariances and transmissions that are computed when they are needed."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from support.optics import SmallBench

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.modes.field_modes import gradient_basis
from reconstruction.registration import prepare_registration
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.runtime.deferred import Deferred
from reconstruction.settings import RegistrationSettings


@pytest.fixture
def displacement(checker_bench: SmallBench) -> Displacement:
    """Quadratic gradients of a frame at rest, its first lenslet dark."""
    reference = checker_bench.reference * np.float32(1000 / checker_bench.reference.max())
    subimages = ReferenceSubimages(
        reference,
        sensor=checker_bench.sensor,
        lattice=checker_bench.lattice,
        field=checker_bench.field,
        noise=KnownNoise(CameraNoise(1.0, 8.0)),
    )
    estimate = prepare_registration(
        subimages, RegistrationSettings(warp="quadratic", rotation=False), checker_bench.field
    )
    frame = reference.copy()
    row, column = np.indices(frame.shape)
    x, y = checker_bench.lattice.lenslet_centers_px(7, 9)[0, 0]
    frame[np.hypot(row - y, column - x) < 22] = 0
    return estimate(frame, saturated=np.zeros(frame.shape, np.bool_))


def _mean_variance(covariance: Floats) -> Floats:
    return np.asarray(np.trace(covariance.reshape(7, 9, 12, 12), axis1=2, axis2=3) / 12)


def test_mean_variance_is_that_of_the_covariance(displacement: Displacement) -> None:
    before = displacement.mean_variance
    assert displacement.covariance.shape == (7, 9, 6, 2, 6, 2)
    np.testing.assert_allclose(before, _mean_variance(displacement.covariance), rtol=1e-6)
    np.testing.assert_allclose(displacement.mean_variance, before, rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(before), ~displacement.valid)
    assert not displacement.valid[0, 0]
    assert np.isnan(displacement.covariance[~displacement.valid]).all()


def test_covariance_lies_in_the_space_of_gradients(displacement: Displacement) -> None:
    covariance = displacement.covariance[3, 4].transpose(1, 0, 3, 2).reshape(12, 12)
    basis = gradient_basis(displacement.modes)  # type: ignore[arg-type] # Legendre
    within = basis.T @ basis @ covariance @ basis.T @ basis
    np.testing.assert_allclose(covariance, within, atol=1e-6 * covariance.max())
    assert np.linalg.matrix_rank(covariance, tol=1e-6 * covariance.max()) == 9


def test_copies_have_the_same_covariance(displacement: Displacement) -> None:
    stored = pickle.loads(pickle.dumps(displacement))  # noqa: S301 - written above
    moved = replace(displacement, coefficients=displacement.coefficients + 1)
    for copy in (stored, moved):
        np.testing.assert_array_equal(copy.covariance, displacement.covariance)


def test_subtracting_an_error_computes_no_covariance(displacement: Displacement) -> None:
    """Live refinement subtracts one from every frame; the covariance would take a sixth of its time."""
    bias = np.full_like(displacement.coefficients, 0.25)
    corrected = displacement.minus(bias)
    assert "covariance" not in corrected.__dict__
    np.testing.assert_array_equal(corrected.coefficients, displacement.coefficients - 0.25)
    np.testing.assert_array_equal(corrected.covariance, displacement.covariance)
    np.testing.assert_array_equal(corrected.minus(bias).covariance, displacement.covariance)


def test_transmission_is_computed_when_it_is_read(displacement: Displacement) -> None:
    moved = displacement.minus(np.full_like(displacement.coefficients, 0.25))
    assert isinstance(displacement.transmission_source, Deferred)
    assert not hasattr(displacement.transmission_source, "_value")
    found, of_moved = displacement.transmission, moved.transmission
    assert found is not None
    assert of_moved is not None
    np.testing.assert_array_equal(of_moved.coefficients, found.coefficients)
    np.testing.assert_array_equal(np.isnan(found.coefficients[..., 0]), ~displacement.valid)
