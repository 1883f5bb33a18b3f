"""Inspection of lenslets whose light is Gaussian, displaced and stretched in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.gaussian_lenslets import SHIFT_PX, inspected

from app.results.view_maps import inspect_lenslet
from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus
from reconstruction.frame.linearity import Linearity


@pytest.mark.parametrize("brightness", [1.0, 0.6])
def test_warp_brings_the_frame_back_onto_the_reference(brightness: float) -> None:
    found = inspect_lenslet(inspected(brightness), 4, 7)
    assert found is not None
    middle = found.reference.shape[0] // 2
    assert found.reference[middle, middle] == pytest.approx(20000, rel=0.02)
    assert found.fitted is not None
    assert found.residual is not None
    fitted = np.isfinite(found.residual)
    assert 0.3 < fitted.mean() < 0.9
    assert np.abs(found.residual[fitted]).max() < 30  # of 20000: interpolation and rounding
    unfitted = found.reference - found.frame / brightness
    assert np.abs(unfitted).max() > 3000
    peak = np.array(np.unravel_index(found.frame.argmax(), found.frame.shape)) - (found.frame.shape[0] - 1) / 2
    np.testing.assert_allclose(peak[::-1], SHIFT_PX, atol=0.6)  # x is the column


@pytest.mark.parametrize("neglect_propagation", [False, True])
def test_bent_subimage_keeps_its_brightness_or_its_flux(neglect_propagation: bool) -> None:
    found = inspect_lenslet(inspected(bend_px=0.8, neglect_propagation=neglect_propagation), 4, 7)
    assert found is not None
    assert found.residual is not None
    assert np.nanmax(np.abs(found.residual)) < 60  # with the other law, more than a thousand


def test_numbers_are_those_of_the_registration() -> None:
    found = inspect_lenslet(inspected(), 4, 7)
    assert found is not None
    assert found.outcome is LensletStatus.CONVERGED
    np.testing.assert_allclose(found.displacement_px, SHIFT_PX)
    np.testing.assert_allclose(found.sigma_px, [0.02, 0.03])


def test_nonlinear_camera_shows_the_light_that_was_fitted() -> None:
    """Counts of a camera that loses 15 % of 20000: light L = S (1 + 0.15 S / 20000), solved for the signal S."""
    measurement = inspected(0.6)
    calibration = measurement.calibration
    assert calibration is not None
    linearity = Linearity(quadratic=0.15, highest_counts=20000)

    def counts(light: Floats) -> Floats:
        return np.asarray(500 + 20000 / 0.3 * (np.sqrt(1 + 0.6 * (light - 500) / 20000) - 1))

    pixels = np.rint(counts(measurement.frame.pixels.astype(np.float64))).astype(np.uint16)
    reference = replace(
        calibration.reference, mean=counts(calibration.reference.mean.astype(np.float64)).astype(np.float32)
    )
    calibration = replace(calibration, bench=replace(calibration.bench, linearity=linearity), reference=reference)
    found = inspect_lenslet(
        replace(measurement, frame=replace(measurement.frame, pixels=pixels), calibration=calibration), 4, 7
    )
    linear = inspect_lenslet(measurement, 4, 7)
    assert found is not None
    assert linear is not None
    for shown, expected in ((found.reference, linear.reference), (found.frame, linear.frame)):
        np.testing.assert_allclose(shown, expected, atol=2)  # of 20000: rounding to counts
    assert found.residual is not None
    assert np.nanmax(np.abs(found.residual)) < 30  # uncorrected: hundreds


def test_lost_lenslet_shows_its_subimages_and_reason() -> None:
    measurement = inspected()
    assert measurement.registered is not None
    outcome = measurement.registered.outcome.copy()
    outcome[4, 7] = LensletStatus.LEFT_CELL
    found = inspect_lenslet(replace(measurement, registered=replace(measurement.registered, outcome=outcome)), 4, 7)
    assert found is not None
    assert found.outcome is LensletStatus.LEFT_CELL
    assert found.fitted is None
    assert found.residual is None
    assert found.frame.max() > 10000


def test_nothing_is_inspected_without_calibration_or_beside_the_lattice() -> None:
    assert inspect_lenslet(replace(inspected(), calibration=None), 4, 7) is None
    assert inspect_lenslet(inspected(), 9, 7) is None
