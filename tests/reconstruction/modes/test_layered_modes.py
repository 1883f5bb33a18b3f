"""Layered wavefronts against the polynomials Phi(a u + b x) themselves."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.field_modes import LegendreModes, ZernikeModes
from reconstruction.modes.layered_modes import layered_basis
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes
from reconstruction.settings import PupilBasis

SENSOR = sensor_of(7, 12)  # half widths 1.75 mm and 3 mm
FIELD_HALF_M = 0.6e-3
PLACES = 600
GENERATOR = np.random.default_rng(0)
U_M, V_M = GENERATOR.uniform(-1, 1, (2, PLACES)) * np.array(SENSOR.pupil_half_width_m)[:, None]
X, Y = GENERATOR.uniform(-1, 1, (2, PLACES))


def values_at_places(modes: PupilModes, field: LegendreModes | ZernikeModes, sensor: Sensor) -> Floats:
    """R_p T_q at all places, (place, (pupil_mode - 1) * field_mode)."""
    half_x, half_y = sensor.pupil_half_width_m
    highest = modes.products.shape[1] - 1
    along_u, along_v = (np.polynomial.legendre.legvander(at, highest) for at in (U_M / half_x, V_M / half_y))
    pupil = np.einsum("pnm,in,im->ip", modes.products[1:], along_v, along_u)
    return np.asarray(np.einsum("ip,qi->ipq", pupil, field.values(X, Y)).reshape(PLACES, -1))


def basis_of(
    modes: PupilModes, field: LegendreModes | ZernikeModes, sensor: Sensor, scale: Floats | None = None
) -> Floats:
    scale = np.ones((len(modes.degree) - 1, field.count)) if scale is None else scale
    return layered_basis(modes.products[1:], field.products, scale, np.array(sensor.pupil_half_width_m))


def left(basis: Floats, wavefront: Floats) -> float:
    """Share of a wavefront's RMS that no wavefront of the basis explains; any function of the field is allowed."""
    known = np.concatenate([basis, LegendreModes(28).values(X, Y).T], axis=1)
    fitted = known @ np.linalg.lstsq(known, wavefront)[0]
    return float(np.std(wavefront - fitted) / np.std(wavefront))


@pytest.mark.parametrize(
    ("pupil", "field"), [("legendre", LegendreModes), ("zernike", ZernikeModes), ("legendre", ZernikeModes)]
)
def test_layers_are_in_the_span_and_rotation_is_not(
    pupil: PupilBasis, field: type[LegendreModes | ZernikeModes]
) -> None:
    modes, field_modes = pupil_modes(SENSOR, pupil, 28), field(10)  # degrees 6 and 3
    basis = values_at_places(modes, field_modes, SENSOR) @ basis_of(modes, field_modes, SENSOR)
    assert basis.shape[1] == sum(n + m + 1 for n in range(1, 7) for m in range(4))
    generator = np.random.default_rng(1)
    for degree in (1, 2, 3):  # of degree 3 in the field at most
        for distance_m in (-0.4, 0.05, 0.3):
            ray_m = np.stack([U_M, V_M]) + distance_m / 0.2 * FIELD_HALF_M * np.stack([X, Y])
            powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i) if i + j > 0]
            layer = sum(generator.normal() * (ray_m[0] / 2e-3) ** i * (ray_m[1] / 2e-3) ** j for i, j in powers)
            assert left(basis, np.asarray(layer)) < 1e-9
    u, v = U_M / 2e-3, V_M / 2e-3
    assert left(basis, u * Y + v * X) < 1e-9
    # Of the rotation, sums of products of other degrees cannot imitate any: it is orthogonal to all but by chance.
    assert left(basis, u * Y - v * X) > 0.3
    assert left(basis, u**3 * Y - u**2 * v * X) > 0.1


def test_polynomials_of_each_degree_span_the_basis() -> None:
    modes, field = pupil_modes(SENSOR, "legendre", 15), LegendreModes(6)
    places = values_at_places(modes, field, SENSOR)
    basis = basis_of(modes, field, SENSOR)
    u, v = U_M / 2e-3, V_M / 2e-3
    layered = []
    # The part of degree n in the pupil and m in the field of ((u + r x)^k (v + r y)^(n + m - k)).
    for n in range(1, 5):
        for m in range(3):
            for k in range(n + m + 1):
                part = np.zeros(PLACES)
                for of_x in range(max(0, m - (n + m - k)), min(k, m) + 1):
                    of_y = m - of_x
                    ways = _choose(k, of_x) * _choose(n + m - k, of_y)
                    part += ways * u ** (k - of_x) * X**of_x * v ** (n + m - k - of_y) * Y**of_y
                layered.append(part)
    expected = np.array(layered).T
    assert np.linalg.matrix_rank(expected) == expected.shape[1] == basis.shape[1]
    known = np.concatenate([places @ basis, field.values(X, Y).T], axis=1)
    fitted = known @ np.linalg.lstsq(known, expected)[0]
    np.testing.assert_allclose(fitted, expected, atol=1e-9 * np.abs(expected).max())


def _choose(n: int, k: int) -> int:
    return int(np.prod(np.arange(n - k + 1, n + 1)) / np.prod(np.arange(1, k + 1)))


def test_basis_is_orthonormal_in_the_units_given() -> None:
    modes, field = pupil_modes(SENSOR, "legendre", 21), LegendreModes(6)
    scale = modes.degree[1:, None] ** -5.0 * 0.5**field.degree
    scaled, plain = basis_of(modes, field, SENSOR, scale), basis_of(modes, field, SENSOR)
    np.testing.assert_allclose(scaled.T @ scaled, np.eye(scaled.shape[1]), atol=1e-12)
    assert scaled.shape == plain.shape
    coefficients = scale.reshape(-1, 1) * scaled
    coefficients /= np.linalg.norm(coefficients, axis=0)
    np.testing.assert_allclose(plain @ (plain.T @ coefficients), coefficients, atol=1e-8)


@pytest.mark.parametrize(("field_modes", "dimension"), [(1, 119), (3, 252), (6, 399), (10, 560)])
def test_dimension_on_the_lattice_of_the_paper(field_modes: int, dimension: int) -> None:
    sensor = sensor_of(15, 15)
    modes = pupil_modes(sensor, "legendre", None)
    assert basis_of(modes, LegendreModes(field_modes), sensor).shape == (119 * field_modes, dimension)
