"""Pupils: fitted to lenslets inside circles and annuli, and chosen if the lit lenslets are round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.annotated_settings import SettingError
from reconstruction.geometry import Sensor
from reconstruction.modes.polynomials import noll_orders
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.pupil import Pupil

SQUARE, PITCH_M = sensor_of(31, 37), 500e-6
ROUND = [(0, 0, 13, 0), (2.3, -1.1, 11.7, 0), (0.4, 0.2, 12.5, 0.3), (0.2, -0.3, 2.6, 0), (0, 0.5, 7.3, 0.4)]


def sensor_with(arrangement: str, pupil: Pupil) -> Sensor:
    return replace(SQUARE, arrangement=arrangement, pupil=pupil)  # type: ignore[arg-type] # of the parameters


def pupil_at(x: float, y: float, radius: float, obscuration: float = 0.0) -> Pupil:
    """A pupil from its centre and radius in pitches."""
    return Pupil.round((x * PITCH_M, y * PITCH_M), radius * PITCH_M, obscuration)


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
@pytest.mark.parametrize(("x", "y", "radius", "obscuration"), ROUND)
@pytest.mark.parametrize("shape", ["fit", "automatic"])
def test_pupil_is_that_of_the_lit_lenslets(
    arrangement: str, x: float, y: float, radius: float, obscuration: float, shape: str
) -> None:
    lit = sensor_with(arrangement, pupil_at(x, y, radius, obscuration)).is_in_pupil
    u, v = np.moveaxis(sensor_with(arrangement, Pupil()).lenslet_centers_m, -1, 0)
    distance = np.hypot(u / PITCH_M - x, v / PITCH_M - y)
    np.testing.assert_array_equal(lit, (distance <= radius) & (distance >= radius * obscuration))
    fitted = sensor_with(arrangement, Pupil(shape=shape)).with_pupil(lit)  # type: ignore[arg-type] # of the parameters
    found = fitted.pupil
    assert found.radius_m is not None
    assert (found.center_x_m / PITCH_M, found.center_y_m / PITCH_M) == pytest.approx((x, y), abs=0.25)  # whole lenslets
    assert found.radius_m / PITCH_M == pytest.approx(radius, abs=0.2)
    assert found.obscuration == pytest.approx(obscuration, abs=0.05)
    assert fitted.is_in_pupil[lit].all()
    assert np.count_nonzero(fitted.is_in_pupil != lit) <= 0.04 * np.count_nonzero(lit)


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (5, 5), (5, 6), (8, 8), (15, 15), (14, 12), (24, 7), (31, 37)])
def test_rectangle_of_lit_lenslets_has_no_round_pupil(arrangement: str, rows: int, columns: int) -> None:
    lit = np.zeros((31, 37), np.bool_)
    lit[:rows, :columns] = True
    unfitted = sensor_with(arrangement, Pupil())
    assert unfitted.with_pupil(lit).pupil == Pupil(shape="all")
    only = replace(unfitted, lenslet_rows=rows, lenslet_columns=columns)
    assert only.with_pupil(lit[:rows, :columns]).pupil == Pupil(shape="all")


def test_few_lost_lenslets_leave_a_round_pupil_as_it_is() -> None:
    lit = sensor_with("square", pupil_at(0, 0, 10)).is_in_pupil
    lit[15, 20] = lit[10, 12] = False
    found = sensor_with("square", Pupil()).with_pupil(lit).pupil
    assert found.shape == "circle"
    assert found.radius_m == pytest.approx(10 * PITCH_M, rel=0.01)


@pytest.mark.parametrize("shape", ["all", "fit"])
def test_shape_without_an_edge_ignores_the_size_of_another(shape: str) -> None:
    """`--set pupil.shape=all` changes a bench that has the pupil which was found."""
    pupil = Pupil(shape=shape, radius_m=1e-3, obscuration=0.2)  # type: ignore[arg-type] # of the parameters
    sensor = sensor_with("square", pupil)
    assert sensor.is_in_pupil.all()
    assert (pupil.in_words, pupil.edges_m.size) == ("", 0)
    assert sensor.circle.radius_m == min(sensor.pupil_half_width_m)


def test_circle_that_the_lattice_cuts_is_no_pupil() -> None:
    sensor = replace(SQUARE, lenslet_rows=15, lenslet_columns=15)
    lit = replace(sensor, pupil=pupil_at(0, 0, 9)).is_in_pupil
    assert not lit.all()
    assert sensor.with_pupil(lit).pupil == Pupil(shape="all")


def test_configured_pupil_stays() -> None:
    pupil = Pupil(shape="square", radius_m=2e-3, center_x_m=1e-3)
    sensor = sensor_with("square", pupil).with_pupil(np.ones((31, 37), np.bool_))
    assert sensor.pupil is pupil
    x, y = np.moveaxis(sensor.lenslet_centers_m, -1, 0)
    np.testing.assert_array_equal(sensor.is_in_pupil, (np.abs(x - 1e-3) <= 2e-3) & (np.abs(y) <= 2e-3))
    assert pupil.edges_m.min(axis=0) == pytest.approx([-1e-3, -2e-3])
    assert pupil.edges_m.max(axis=0) == pytest.approx([3e-3, 2e-3])


@pytest.mark.parametrize("shape", ["fit", "automatic"])
def test_without_light_there_is_no_pupil(shape: str) -> None:
    sensor = sensor_with("square", Pupil(shape=shape))  # type: ignore[arg-type] # of the parameters
    assert sensor.with_pupil(np.zeros((31, 37), np.bool_)).pupil == Pupil(shape="all")


@pytest.mark.parametrize(
    ("settings", "path"),
    [
        ({"radius_m": 1e-3}, "shape"),
        ({"shape": "circle"}, "radius_m"),
        ({"shape": "annulus", "radius_m": 1e-3}, "obscuration"),
        ({"shape": "circle", "radius_m": 1e-3, "obscuration": 0.2}, "obscuration"),
    ],
)
def test_contradictions_are_refused(settings: dict[str, object], path: str) -> None:
    with pytest.raises(SettingError) as refusal:
        Pupil(**settings)  # type: ignore[arg-type] # of the parameters
    assert refusal.value.path == path


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
def test_zernike_modes_of_lenslets_lie_on_the_pupil(arrangement: str) -> None:
    """Defocus and coma of Mahajan's table over an annulus beside the middle, and their mean gradients."""
    e, center_m, radius_m = 0.3, np.array([1.1e-3, -0.7e-3]), 4.1e-3
    sensor = sensor_with(arrangement, Pupil.round((1.1e-3, -0.7e-3), radius_m, e))
    made = pupil_modes(sensor, "zernike", 10)
    x, y = np.moveaxis((sensor.lenslet_centers_m - center_m) / radius_m, -1, 0)
    square = x**2 + y**2
    np.testing.assert_array_equal(made.inside, (square <= 1) & (square >= e**2))
    defocus = np.sqrt(3) * (2 * square - 1 - e**2) / (1 - e**2)
    s2, s3 = 1 + e**2, 1 + e**2 + e**4
    coma = np.sqrt(8) * x * (3 * s2 * square - 2 * s3) / (1 - e**2) / np.sqrt(s2 * (1 + 4 * e**2 + e**4))
    for (n, m), expected in (((2, 0), defocus), ((3, 1), coma)):
        mode = made.values[noll_orders(10).index((n, m))]
        np.testing.assert_allclose(mode, expected, atol=1e-11 * np.abs(expected).max())
    slope = made.gradients[noll_orders(10).index((2, 0))]  # of a parabola: that at the centre
    np.testing.assert_allclose(slope[..., 0], np.sqrt(3) * 4 * x / (1 - e**2) / radius_m, rtol=1e-8, atol=1e-6)
    assert pupil_modes(sensor, "legendre", 10).inside.sum() == made.inside.sum()
