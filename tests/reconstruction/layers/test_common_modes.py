"""Results with and without layers have the same modes, and the same coefficients over the field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import svwfs
from app.measurement.calibration import Calibration
from app.results.dataset import result_dataset, stack_frames
from reconstruction.field_coefficients import ModalFit, fit_coefficients
from reconstruction.geometry import nominal_lattice
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.modes.polynomials import zernike
from reconstruction.quality.isoplanatism import isoplanatism
from reconstruction.settings import ReconstructionSettings
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront, without_piston

BENCH = svwfs.load_bench("small_demo", "simulation.source.mask='checkerboard'", "registration.warp=quartic")


@pytest.fixture(scope="module")
def wavefronts() -> dict[str, Wavefront]:
    """One frame, free and layered; `alone` where layers are not allowed."""
    images = svwfs.simulate(BENCH)
    alone = replace(BENCH, reconstruction=ReconstructionSettings(sample="free"))
    lattice = nominal_lattice(BENCH.sensor, *images.reference.shape)
    automatic, free_only = (
        Calibration.of_images(bench, images.reference, dark=images.dark, lattice=lattice).reconstructor()
        for bench in (BENCH, alone)
    )
    found = automatic(images.frames[0])
    assert len(found.sample.ratios) == 1
    free = automatic.solve(found.displacement, sample=FREE)
    return {"layered": found, "free": free, "alone": free_only(images.frames[0])}


@pytest.mark.slow
def test_free_and_layered_frames_can_be_stacked(wavefronts: dict[str, Wavefront]) -> None:
    free, layered = (result_dataset(wavefronts[name]) for name in ("free", "layered"))
    stacked = stack_frames([free, layered], [0, 1], [0.0, 0.1], [np.nan, np.nan])
    assert stacked["coefficients"].sizes == {"frame": 2, **layered["coefficients"].sizes}


@pytest.mark.slow
def test_more_modes_leave_the_wavefront_as_it_is(wavefronts: dict[str, Wavefront]) -> None:
    free, alone = wavefronts["free"], wavefronts["alone"]
    assert isinstance(free.solution, ModalSolution)
    assert isinstance(alone.solution, ModalSolution)
    count = len(alone.solution.coefficients)
    assert count < len(free.solution.coefficients)
    np.testing.assert_allclose(free.solution.coefficients[:count], alone.solution.coefficients, atol=1e-9)
    assert not free.solution.coefficients[count:].any()
    np.testing.assert_allclose(free.views, alone.views, atol=1e-9)
    np.testing.assert_allclose(free.sigma(), alone.sigma(), rtol=1e-4)


@pytest.mark.parametrize("name", ["layered", "free"])
def test_field_coefficients_are_the_wavefront_at_every_position(wavefronts: dict[str, Wavefront], name: str) -> None:
    wavefront = wavefronts[name]
    found = fit_coefficients(ModalFit.of(wavefront), "zernike")
    sensor, half_m = BENCH.sensor, BENCH.field.half_width_m
    u, v = np.moveaxis(sensor.lenslet_centers_m, -1, 0) / min(sensor.pupil_half_width_m)
    values = zernike(len(found.rad), u, v)
    for x, y in ((0.0, 0.0), (0.9, -0.4), (-1.0, 1.0)):
        made = without_piston(np.tensordot(found.at(x, y), values, axes=1))
        np.testing.assert_allclose(made, wavefront.at(x * half_m, y * half_m), atol=1e-9)


def test_isoplanatism_is_that_of_the_layer(wavefronts: dict[str, Wavefront]) -> None:
    layered, free = (isoplanatism(wavefronts[name]) for name in ("layered", "free"))
    np.testing.assert_allclose(layered.curve.rms_rad, free.curve.rms_rad, rtol=0.03)
    assert layered.error_rad == pytest.approx(free.error_rad, rel=0.02)
