"""Analysis of a wavefront for display."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.gui_bench import BENCH, SENSOR
from support.wavefronts import bowl

from app.results.run_summary import noise_above_rms
from app.results.view_maps import Quantity, QuantityMaps, quantity_maps, view_numbers
from reconstruction.quality.image_quality import diffraction_rad
from reconstruction.wavefront import Wavefront


def maps_of(quantity: Quantity, wavefront: Wavefront | None = None, reach_rad: float | None = None) -> QuantityMaps:
    maps = quantity_maps(wavefront or bowl(), quantity, BENCH.reconstruction, reach_rad)
    assert maps is not None
    return maps


def test_psf_is_displaced_by_tilt() -> None:
    tilt_rad_per_m = 2000.0
    maps = maps_of(Quantity.PSF, bowl(tilt_rad_per_m))
    psf = maps.values[1, 1]
    angle_rad = np.linspace(-maps.reach_rad, maps.reach_rad, psf.shape[0])
    center_rad = [(psf.sum(axis=axis) @ angle_rad) / psf.sum() for axis in (0, 1)]  # along x, along y
    np.testing.assert_allclose(
        center_rad, [tilt_rad_per_m / SENSOR.wavenumber_rad_per_m, 0], atol=0.2 * diffraction_rad(SENSOR)
    )
    wider = maps_of(Quantity.PSF, reach_rad=1.5e-3)
    assert wider.reach_rad == 1.5e-3
    assert wider.light_reach_rad < 1.5e-3


def test_psf_without_light_has_no_maps() -> None:
    dark = bowl()
    dark.views[:] = np.nan
    assert quantity_maps(dark, Quantity.PSF, BENCH.reconstruction) is None


def test_enough_modes_leave_no_residual() -> None:
    np.testing.assert_allclose(maps_of(Quantity.RESIDUAL).values, 0, atol=1e-9)


def test_uncertainty_is_the_sigma_of_the_wavefront() -> None:
    wavefront = bowl()
    maps = maps_of(Quantity.UNCERTAINTY, wavefront).values
    np.testing.assert_array_equal(maps, wavefront.sigma())
    assert np.all(maps > 0)


def test_wavefront_is_its_own_map() -> None:
    wavefront = bowl()
    assert maps_of(Quantity.WAVEFRONT, wavefront).values is wavefront.views


def test_numbers_of_each_view_and_of_all() -> None:
    maps = np.tile([[1.0, -1.0], [3.0, -3.0]], (2, 3, 1, 1))  # of 2 x 3 views
    maps[0, 0, 1], maps[1, 1] = np.nan, np.nan
    phases = view_numbers(Quantity.RESIDUAL, maps)
    assert phases.first[0, 0] == pytest.approx(1)
    assert phases.first[0, 1] == pytest.approx(np.sqrt(5))
    assert phases.second[:, 0].tolist() == [2, 6]
    assert np.isnan([phases.first[1, 1], phases.second[1, 1]]).all()
    assert phases.mean == pytest.approx((1 + 4 * np.sqrt(5)) / 5)
    errors = view_numbers(Quantity.UNCERTAINTY, np.abs(maps))
    assert errors.first[:, 0].tolist() == [1, 2]
    assert errors.second[:, 0].tolist() == [1, 3]
    assert errors.mean == pytest.approx((2 * 1 + 4 * 8) / 18)
    light = np.zeros((1, 2, 3, 5))
    light[0, 1, 1, 2], light[0, 1, 0, 4] = 0.6, 0.7
    peaks = view_numbers(Quantity.PSF, light)
    assert (peaks.first.tolist(), peaks.second.tolist()) == ([[0, 0.6]], [[0, 0.7]])


def test_noise_is_told_if_it_hides_the_wavefront() -> None:
    wavefront = bowl()
    noise_rad = float(np.sqrt(np.mean(wavefront.sigma() ** 2)))
    assert 1.1 * noise_rad < 0.1
    for share in (0.9, 1.1):
        views = np.zeros_like(wavefront.views)
        views[..., ::2, :], views[..., 1::2, :] = share * noise_rad, -share * noise_rad
        views -= views.mean(axis=(2, 3), keepdims=True)
        found = noise_above_rms(replace(wavefront, views=views))
        assert found == (pytest.approx(noise_rad) if share < 1 else None)
