"""Coefficients of wavefronts that are sums of known modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from support.gui_bench import FIELD, SENSOR
from support.wavefronts import bowl, modal

from app.results.coefficients import ModeChoice, double_zernikes, field_coefficients, mode_coefficients, table_of
from reconstruction.arrays import Floats
from reconstruction.modes.pupil_modes import BASES
from reconstruction.solve.modal import ModalSolution

CENTRE, RIGHT, CORNER = (1, 1), (1, 2), (0, 2)  # views


def known_coefficients() -> Floats:
    return np.asarray(np.random.default_rng(5).normal(0, 0.5, (15, 3)) * np.arange(15)[:, None].clip(0, 1))


def test_modes_of_the_reconstruction_come_back_at_the_selected_view() -> None:
    coefficients = known_coefficients()
    wavefront = modal(coefficients, sigma_px=np.array([[0.02], [0.01], [0.05]]))
    found = mode_coefficients(wavefront, ModeChoice("legendre", None, RIGHT))
    at = np.array([1.0, 0.5 / 0.6, 0.0])  # T_q at x = +0.5 mm, y = 0
    np.testing.assert_allclose(found.rad[1:15], (coefficients @ at)[1:], atol=1e-4)
    np.testing.assert_allclose(found.rad[15:], 0, atol=1e-4)
    solution = wavefront.solution
    assert isinstance(solution, ModalSolution)
    deviations = np.einsum("q,pqn->pn", at, solution.root_covariance)
    np.testing.assert_allclose(found.sigma_rad[1:15], np.linalg.norm(deviations, axis=1), rtol=1e-3)


def test_coefficients_of_a_field_mode_are_its_e_pq() -> None:
    coefficients = known_coefficients()
    wavefront = modal(coefficients, sigma_px=0.02)
    found = mode_coefficients(wavefront, ModeChoice("legendre", 2, CENTRE))
    np.testing.assert_allclose(found.rad[1:15], coefficients[1:, 2], atol=1e-4)
    solution = wavefront.solution
    assert isinstance(solution, ModalSolution)
    np.testing.assert_allclose(found.sigma_rad[1:15], solution.coefficients_sigma[1:, 2], rtol=1e-3)


def test_zernike_coefficients_of_closed_forms() -> None:
    radius_m = min(SENSOR.pupil_half_width_m)
    x, y = SENSOR.pupil_x_m / radius_m, SENSOR.pupil_y_m[:, None] / radius_m
    defocus = np.sqrt(3) * (2 * (x**2 + y**2) - 1)
    astigmatism, coma = np.sqrt(6) * 2 * x * y, np.sqrt(8) * (3 * (x**2 + y**2) - 2) * x
    wavefront = bowl()
    wavefront.views[CORNER] = 0.4 * defocus - 0.3 * astigmatism + 0.2 * coma + 5.0
    wavefront.views[CORNER][x**2 + y**2 > 1] = 7.0  # outside the circle, which the modes do not cover
    found = mode_coefficients(wavefront, ModeChoice("zernike", None, CORNER))
    values = {name.split(" ", 1)[1]: rad for name, rad in zip(found.names, found.rad, strict=True)}
    assert values["defocus"] == pytest.approx(0.4)
    assert values["astigmatism at 45\N{DEGREE SIGN}"] == pytest.approx(-0.3)
    assert values["coma along x"] == pytest.approx(0.2)
    assert sum(abs(rad) > 1e-9 for rad in values.values()) == 4  # with the piston
    assert np.isnan(found.sigma_rad).all()  # zonal: unknown


def test_lost_lenslets_do_not_change_the_fit() -> None:
    wavefront = modal(known_coefficients())
    choice = ModeChoice("legendre", None, CENTRE)
    before = mode_coefficients(wavefront, choice).rad
    wavefront.views[1, 1, 3:5, 4:6] = np.nan
    np.testing.assert_allclose(mode_coefficients(wavefront, choice).rad[1:], before[1:], atol=1e-4)
    wavefront.views[1, 1] = np.nan
    assert np.isnan(mode_coefficients(wavefront, choice).rad).all()


def test_field_map_of_a_coefficient() -> None:
    coefficients = np.zeros((6, 3))
    coefficients[3] = (0.5, 1.0, -2.0)
    found = mode_coefficients(modal(coefficients), ModeChoice("legendre", None, CENTRE, mapped=3)).field_map
    assert found is not None
    x = np.linspace(-1, 1, 21)
    np.testing.assert_allclose(found, 0.5 + x - 2 * x[:, None], atol=1e-4)
    circle = replace(modal(coefficients), field=replace(FIELD, shape="circle", view_spacing_m=0.4e-3))
    outside = mode_coefficients(circle, ModeChoice("legendre", None, CENTRE, mapped=3)).field_map
    assert outside is not None
    np.testing.assert_array_equal(np.isnan(outside), x**2 + x[:, None] ** 2 > 1 + 1e-9)
    maps = field_coefficients(circle, "legendre", positions=21)
    for name in ("coefficient", "coefficient_sigma"):
        np.testing.assert_array_equal(np.isnan(maps[name][3]), np.isnan(outside), err_msg=name)


def test_double_zernikes_name_the_radii_of_field_and_pupil() -> None:
    """9 x 13 lenslets of 0.5 mm: the circle has a radius of 2.25 mm; a field of +-0.6 mm."""
    coefficients = np.zeros((6, 3))
    coefficients[3, 0] = 0.4
    found = double_zernikes(modal(coefficients, basis="zernike"))
    assert (found.attrs["xy_outer"], found.attrs["uv_outer"]) == pytest.approx((2.25e-3, 0.6e-3))
    assert float(found["double_zernike"][1, 4]) == pytest.approx(0.4, abs=1e-4)


def test_table_has_a_row_for_each_field_position_inside() -> None:
    values = np.array([[[1.0, 2.0, np.nan], [4.0, 5.0, 6.0]]])  # of one mode, at 2 x 3 positions
    maps = xr.Dataset(
        {"coefficient": (("mode", "y", "x"), values), "coefficient_sigma": (("mode", "y", "x"), values / 10)},
        {"name": ("mode", ["Z4 defocus"]), "x": [-3e-4, 0.0, 3e-4], "y": [-1e-4, 1e-4]},
    )
    names, rows = table_of(maps)
    assert names == ["x_m", "y_m", "Z4_rad", "Z4_sigma_rad"]
    assert rows[0] == pytest.approx([-3e-4, -1e-4, 1.0, 0.1])
    assert rows[-1] == pytest.approx([3e-4, 1e-4, 6.0, 0.6])
    assert len(rows) == 5


def test_names_count_as_noll_and_as_the_paper_do() -> None:
    assert BASES["zernike"].names(11)[3::7] == ("Z4 defocus", "Z11 spherical aberration")
    assert BASES["zernike"].names(8)[6:] == ("Z7 coma along y", "Z8 coma along x")
    assert BASES["legendre"].names(6) == ("L0 piston", "L1 P1(x)", "L2 P1(y)", "L3 P2(x)", "L4 P1(x) P1(y)", "L5 P2(y)")
