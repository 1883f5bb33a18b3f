"""Coefficients over the field against closed forms, SciPy's Jacobi polynomials, GalSim and the fit's covariance."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import legendre as series
from scipy.special import eval_jacobi
from support.gui_bench import FIELD, SENSOR
from support.paths import TESTS
from support.wavefronts import bowl, modal

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import FieldCoefficients, ModalFit, fit_coefficients
from reconstruction.modes.field_modes import FieldModes, LegendreModes, SampledModes, ZernikeModes
from reconstruction.modes.polynomials import legendre_orders
from reconstruction.modes.pupil_modes import BASES, pupil_modes
from reconstruction.settings import PupilBasis

RADIUS_M = min(SENSOR.pupil_half_width_m)
SCALE = RADIUS_M / np.array(SENSOR.pupil_half_width_m)  # of the circle in the lattice
HIGHEST = 10
MODES = (HIGHEST + 1) * (HIGHEST + 2) // 2


def jacobi_zernike(j: int, x: Floats, y: Floats) -> Floats:
    """Noll's mode j, from 1, by Jacobi polynomials: shares nothing with the product."""
    n, first = 0, 1
    while first + n < j:
        first, n = first + n + 1, n + 1
    m = [abs(m) for m in sorted(range(-n, n + 1, 2), key=abs)][j - first]
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    radial = (-1) ** ((n - m) // 2) * r**m * eval_jacobi((n - m) // 2, m, 0, 1 - 2 * r**2)
    if m == 0:
        return np.asarray(np.sqrt(n + 1) * radial)
    return np.asarray(np.sqrt(2 * n + 2) * radial * (np.cos(m * angle) if j % 2 == 0 else np.sin(m * angle)))


def fitted(rad: Floats, field_modes: FieldModes, *, basis: PupilBasis = "legendre") -> ModalFit:
    exact = np.zeros((len(rad) - 1, rad.shape[1], 1))
    known = np.ones(SENSOR.lenslets, np.bool_)
    modes = pupil_modes(SENSOR, basis, len(rad))
    return ModalFit(SENSOR, modes, field_modes, rad, exact, known)


def smooth_coefficients(field_modes: int, basis: PupilBasis) -> Floats:
    """Coefficients that fall with the degree, as those of real wavefronts."""
    degree = pupil_modes(SENSOR, basis, MODES).degree
    fall = np.maximum(degree, 1)[:, None] ** -3.0 * (degree > 0)[:, None]
    return np.asarray(np.random.default_rng(3).normal(size=(MODES, field_modes)) * fall)


@pytest.mark.parametrize("basis", ["legendre", "zernike"])
@pytest.mark.parametrize(
    ("field_modes", "values"),
    [
        (
            LegendreModes(10),
            lambda x, y: [
                series.legval(x, np.eye(4)[m]) * series.legval(y, np.eye(4)[n]) for m, n in legendre_orders(10)
            ],
        ),
        (ZernikeModes(10), lambda x, y: [jacobi_zernike(k, x, y) for k in range(1, 11)]),
        (
            SampledModes(np.array([-0.8, 0.8]), np.array([-0.8, 0.8])),
            lambda x, y: [(1 + sx * x / 0.8) * (1 + sy * y / 0.8) / 4 for sy in (-1, 1) for sx in (-1, 1)],
        ),
    ],
    ids=["square", "circle", "stars"],
)
def test_double_zernikes_are_the_wavefront(
    basis: PupilBasis, field_modes: FieldModes, values: Callable[[Floats, Floats], list[Floats]]
) -> None:
    """sum_kj d[k, j] Z_k(field) Z_j(pupil) by SciPy equals sum_pq e_pq R_p T_q within the circles, without piston."""
    rad = smooth_coefficients(field_modes.count, basis)
    double, _ = fit_coefficients(fitted(rad, field_modes, basis=basis), "zernike").double_zernikes()
    rng = np.random.default_rng(0)
    radius, angle = np.sqrt(rng.uniform(size=(2, 60))), rng.uniform(0, 2 * np.pi, (2, 60))
    (field_x, pupil_x), (field_y, pupil_y) = radius * np.cos(angle), radius * np.sin(angle)
    if basis == "zernike":
        pupil = np.array([jacobi_zernike(j, pupil_x, pupil_y) for j in range(1, MODES + 1)])
    else:
        x, y, unit = pupil_x * SCALE[0], pupil_y * SCALE[1], np.eye(HIGHEST + 1)
        orders = legendre_orders(MODES)
        pupil = np.array([series.legval(x, unit[m]) * series.legval(y, unit[n]) for m, n in orders])
    expected = np.einsum("pq,pu,qx->xu", rad, pupil, np.array(values(field_x, field_y)))
    of_field = np.array([jacobi_zernike(k, field_x, field_y) for k in range(1, len(double))])
    of_pupil = np.array([jacobi_zernike(j, pupil_x, pupil_y) for j in range(1, double.shape[1])])
    found = np.einsum("kj,kx,ju->xu", double[1:, 1:], of_field, of_pupil)
    without_piston = expected - expected[:, :1], found - found[:, :1]
    np.testing.assert_allclose(without_piston[1], without_piston[0], atol=1e-12)
    assert np.abs(without_piston[0]).max() > 1
    assert not double[0].any()
    assert not double[:, :2].any()  # nor the piston


def test_galsim_evaluates_the_same_wavefront() -> None:
    """Values of galsim.zernike.DoubleZernike; tests/support/galsim.json says how they were made."""
    made = json.loads((TESTS / "support" / "galsim.json").read_text("utf-8"))
    assert (made["xy_outer"], made["uv_outer"]) == pytest.approx((RADIUS_M, FIELD.half_width_m))
    rad = np.array(made["rad"])
    fit = fitted(rad, LegendreModes(rad.shape[1]))
    double, _ = fit_coefficients(fit, "zernike").double_zernikes()
    np.testing.assert_allclose(double, made["double_zernike"], atol=1e-12)
    for (u, v, x, y), value in zip(made["uvxy_m"], made["wavefront_rad"], strict=True):
        at = fit_coefficients(fit, "zernike").at(u / made["uv_outer"], v / made["uv_outer"])
        modes = [jacobi_zernike(j, np.array(x / RADIUS_M), np.array(y / RADIUS_M)) for j in range(1, len(at) + 1)]
        assert np.dot(at, modes) == pytest.approx(value, abs=1e-12)


def test_defocus_that_grows_over_the_field_is_one_double_zernike() -> None:
    """e(x) = x times defocus: Z_2 = 2 x over the field, so d[2, 4] = 1/2."""
    rad = np.zeros((6, 3))
    rad[3, 1] = 1.0  # Noll's defocus is the fourth mode; T_1 = x
    double, _ = fit_coefficients(fitted(rad, LegendreModes(3), basis="zernike"), "zernike").double_zernikes()
    expected = np.zeros((4, 7))
    expected[2, 4] = 0.5
    np.testing.assert_allclose(double, expected, atol=1e-14)


def test_legendre_modes_of_the_fit_come_back() -> None:
    rad = smooth_coefficients(6, "legendre")
    fit = fitted(rad, LegendreModes(6))
    found = fit_coefficients(fit, "legendre")
    np.testing.assert_allclose(found.rad, rad, atol=1e-15)
    np.testing.assert_allclose(fit_coefficients(fit, "legendre", 4).rad, rad[:15], atol=1e-15)
    x, y = 0.3, -0.7
    field = [1, x, y, (3 * x**2 - 1) / 2, x * y, (3 * y**2 - 1) / 2]
    np.testing.assert_allclose(found.at(x, y), rad @ field, atol=1e-14)


def test_zernike_modes_in_legendre_modes() -> None:
    """Defocus over the circle, sqrt(3) (2 r^2 - 1), in P_2 = (3 x^2 - 1) / 2 over the lattice."""
    rad = np.zeros((6, 1))
    rad[3] = 1.0
    found = fit_coefficients(fitted(rad, LegendreModes(1), basis="zernike"), "legendre").rad[:, 0]
    expected = np.zeros(6)
    expected[[3, 5]] = np.sqrt(3) * 4 / 3 / SCALE**2
    np.testing.assert_allclose(found, expected, atol=1e-13)


def test_coefficients_do_not_depend_on_the_order() -> None:
    fit = fitted(smooth_coefficients(3, "legendre"), LegendreModes(3))
    every, some = (fit_coefficients(fit, "zernike", order) for order in (None, 4))
    np.testing.assert_allclose(some.rad, every.rad[:15], atol=1e-15)
    np.testing.assert_allclose(some.double_zernikes(0)[0], every.double_zernikes()[0][:2, :16], atol=1e-15)


def test_errors_are_those_of_the_covariance() -> None:
    """Against the covariance of all pairs of e_pq, transformed coefficient by coefficient."""
    root = np.random.default_rng(5).normal(size=(14, 6, 100))
    fit = replace(fitted(np.zeros((15, 6)), LegendreModes(6)), root_covariance=root)
    found = fit_coefficients(fit, "zernike")
    covariance = np.tensordot(root, root, axes=((2,), (2,))).reshape(84, 84)
    each = np.eye(15 * 6).reshape(-1, 15, 6)[6:]
    unit = [fit_coefficients(fitted(rad, LegendreModes(6)), "zernike") for rad in each]
    x, y = np.array([0.0, -0.9, 0.4]), np.array([0.0, 0.2, 0.9])
    at = np.array([of.at(x, y) for of in unit])  # (e_pq, mode, position)
    np.testing.assert_allclose(found.sigma(x, y) ** 2, np.einsum("amx,ab,bmx->mx", at, covariance, at), rtol=1e-9)
    doubles = np.array([of.double_zernikes()[0] for of in unit])
    expected = np.einsum("akj,ab,bkj->kj", doubles, covariance, doubles)
    np.testing.assert_allclose(found.double_zernikes()[1] ** 2, expected, rtol=1e-9)


def test_errors_cover_the_scatter_of_noisy_fits() -> None:
    """200 fits of displacements with independent errors scatter as the error bars say."""
    rad, sigma_px = np.zeros((10, 3)), 0.05
    wavefront = modal(rad, sigma_px=sigma_px)
    expected = fit_coefficients(ModalFit.of(wavefront), "zernike").sigma(0.5, -0.5)[1:]
    rng = np.random.default_rng(1)
    found = []
    for _ in range(200):
        noisy = modal(rad, sigma_px=sigma_px, noise=rng)
        found.append(fit_coefficients(ModalFit.of(noisy), "zernike").at(0.5, -0.5)[1:])
    np.testing.assert_allclose(np.std(found, axis=0), expected, rtol=0.2)


def refused(make: Callable[[], object]) -> str:
    with pytest.raises(ReconstructionError) as error:
        make()
    return str(error.value)


def coefficients(field_modes: int) -> FieldCoefficients:
    return fit_coefficients(fitted(smooth_coefficients(field_modes, "legendre"), LegendreModes(field_modes)), "zernike")


def test_orders_that_the_data_do_not_hold_are_refused() -> None:
    fit = fitted(smooth_coefficients(3, "legendre"), LegendreModes(3))
    assert "degree 11 of the pupil modes must be 1 ... 10" in refused(lambda: fit_coefficients(fit, "zernike", 11))
    unknown = refused(lambda: fit_coefficients(fit, "foo"))  # type: ignore[arg-type] # refused
    assert f"no basis foo: it must be {' or '.join(BASES)}" in unknown
    assert "field order 2 exceeds that of the 3 field modes, 1" in refused(lambda: coefficients(3).double_zernikes(2))
    assert "field order 1 exceeds that of the 1 field modes, 0" in refused(lambda: coefficients(1).double_zernikes(1))
    assert coefficients(1).double_zernikes(0)[0].shape == (2, MODES + 1)
    legendre = fit_coefficients(fit, "legendre")
    assert "made of Zernike modes" in refused(legendre.double_zernikes)


def test_zonal_wavefront_is_fitted_at_the_lenslet_centres() -> None:
    """A bowl 1e6 (1 + x / 2) (u^2 + v^2) rad/m^2: its defocus over the circle is 1e6 R^2 / (2 sqrt(3))."""
    found = fit_coefficients(ModalFit.of(bowl()), "zernike", 2)
    defocus_rad = 1e6 * RADIUS_M**2 / (2 * np.sqrt(3))
    np.testing.assert_allclose(found.at(np.array([0.0, 1.0]), 0.0)[3], [defocus_rad, 1.5 * defocus_rad], rtol=1e-6)
    assert np.isnan(found.sigma(0.0, 0.0)).all()


def test_wavefront_without_known_lenslets_is_refused() -> None:
    fit = fitted(smooth_coefficients(3, "legendre"), LegendreModes(3))
    fit.known[1:-1] = False
    corners = np.hypot(SENSOR.pupil_x_m, SENSOR.pupil_y_m[:, None]) > RADIUS_M
    fit.known[:] = corners
    assert "no lenslet is known inside the pupil" in refused(lambda: fit_coefficients(fit, "zernike"))
    assert fit_coefficients(fit, "legendre").known_share == pytest.approx(corners.mean())
