"""Analysis of a wavefront for display."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.gui_bench import BENCH, SENSOR
from support.wavefronts import U, V, bowl

from app.results.view_analysis import AnalysisRequest, Quantity, analyse
from reconstruction.quality.image_quality import diffraction_rad
from reconstruction.wavefront import Wavefront, without_piston


def request(quantity: Quantity, wavefront: Wavefront | None = None) -> AnalysisRequest:
    return AnalysisRequest(wavefront or bowl(), BENCH.reconstruction, quantity, None, None)


def test_psf_is_displaced_by_tilt() -> None:
    tilt_rad_per_m = 2000.0
    analysis = analyse(request(Quantity.PSF, bowl(tilt_rad_per_m)))
    assert analysis.maps is not None
    psf = analysis.maps[1, 1]
    angle_rad = np.linspace(-analysis.reach_rad, analysis.reach_rad, psf.shape[0])
    center_rad = [(psf.sum(axis=axis) @ angle_rad) / psf.sum() for axis in (0, 1)]  # along x, along y
    np.testing.assert_allclose(
        center_rad, [tilt_rad_per_m / SENSOR.wavenumber_rad_per_m, 0], atol=0.2 * diffraction_rad(SENSOR)
    )
    wider = analyse(replace(request(Quantity.PSF), reach_rad=1.5e-3))
    assert wider.reach_rad == 1.5e-3
    assert wider.light_reach_rad < 1.5e-3


def test_enough_modes_fit_the_measured_wavefront() -> None:
    expected = without_piston(1e6 * (U**2 + V**2))
    for quantity, factor in ((Quantity.MEASURED, 1.0), (Quantity.FITTED, 1.0), (Quantity.DIFFERENCE, 0.0)):
        maps = analyse(request(quantity)).maps
        assert maps is not None
        np.testing.assert_allclose(maps[1, 1], factor * expected, atol=1e-9)
        np.testing.assert_allclose(maps[1, 2], factor * expected * (1 + 0.5 * 5 / 6), atol=1e-9)


def test_uncertainty_is_the_sigma_of_the_wavefront() -> None:
    wavefront = bowl()
    maps = analyse(request(Quantity.UNCERTAINTY, wavefront)).maps
    np.testing.assert_array_equal(maps, wavefront.sigma())
    assert maps is not None
    assert np.all(maps > 0)


def test_only_what_is_requested_is_computed() -> None:
    nothing = analyse(request(Quantity.WAVEFRONT))
    assert (nothing.maps, nothing.transfer, nothing.isoplanatism) == (None, None, None)
    curves = analyse(replace(request(Quantity.WAVEFRONT), view=(0, 2)))
    assert curves.maps is None
    assert curves.transfer is not None
    assert curves.isoplanatism is not None
    # the wavefronts differ by the growth of the bowl alone: 5e5 r^2 over the half width of the field
    growth_rad = np.std(5e5 * (U**2 + V**2))
    np.testing.assert_allclose(curves.isoplanatism.curve.most_rad[0], growth_rad * 2 / 7)
