"""Space-variant blur: ordinary convolution as its special case, adjoint, light, and true interpolation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy  # which loads its parts when they are used

from reconstruction.deconvolution.blur import SpaceVariantBlur
from reconstruction.deconvolution.corrected_image import regularised, restored
from reconstruction.frame.noise import CameraNoise

SHAPE, REACH = (70, 90), 6
RNG = np.random.default_rng(3)
AT = np.arange(-REACH, REACH + 1)


def lobe(x: float, y: float, width: float = 1.5) -> np.ndarray[Any, Any]:
    """An asymmetric pattern about (x, y), sum 1."""
    values = np.exp(-((AT - x) ** 2 + 0.5 * (AT[:, None] - y) ** 2) / (2 * width**2)) * (1.2 + np.tanh(AT - x))
    return np.asarray(values / values.sum())


def varying(x_px: float, y_px: float) -> np.ndarray[Any, Any]:
    return lobe(x_px / 60 - 0.5, 0.5 - y_px / 45, 1.2 + x_px / 120)


def blur(psf_at: Any, change: float = 0.02, shape: tuple[int, int] = SHAPE, **changes: Any) -> SpaceVariantBlur:
    known = (0, shape[0] - 1), (0, shape[1] - 1)
    settings = {"reach_px": REACH, "known_px": known, "change_rad_per_px": change, "dtype": np.float64, **changes}
    return SpaceVariantBlur(psf_at, shape, **settings)


def test_constant_pattern_is_an_ordinary_convolution() -> None:
    constant = blur(lambda *_: lobe(1.0, -2.0))
    scene = RNG.random(constant.object_shape)
    expected = scipy.signal.fftconvolve(scene, lobe(1.0, -2.0), mode="valid")
    np.testing.assert_allclose(constant(scene), expected, atol=1e-12)
    for mirrored in (lobe(1.0, -2.0)[:, ::-1], lobe(1.0, -2.0).T):
        assert np.abs(constant(scene) - scipy.signal.fftconvolve(scene, mirrored, mode="valid")).max() > 0.01


def test_constant_pattern_makes_ordinary_richardson_lucy() -> None:
    constant, kernel = blur(lambda *_: lobe(0.7, 0.3)), lobe(0.7, 0.3)
    scene = RNG.random(constant.object_shape) ** 8
    image = scipy.signal.fftconvolve(scene, kernel, mode="valid") * RNG.uniform(0.9, 1.1, SHAPE)
    found = restored(image, constant, "richardson-lucy", noise=None, counted=np.ones(SHAPE, np.bool_), iterations=20)
    seen = scipy.signal.correlate(np.ones(SHAPE), kernel, mode="full", method="direct")
    estimate = np.where(seen > 0.01, image.mean(), 0)
    for _ in range(20):
        ratio = image / scipy.signal.convolve(estimate, kernel, mode="valid", method="direct")
        estimate *= scipy.signal.correlate(ratio, kernel, mode="full", method="direct") * np.where(
            seen > 0.01, 1 / np.maximum(seen, 0.01), 0
        )
    expected = estimate[REACH:-REACH, REACH:-REACH]
    assert found.iterations == 20
    np.testing.assert_allclose(found.image, expected, rtol=1e-6, atol=1e-6 * expected.max())


def test_constant_pattern_makes_the_ordinary_wiener_filter() -> None:
    shape = (14, 16)
    constant = blur(lambda *_: lobe(0.7, 0.3), shape=shape)
    image = RNG.random(shape)
    rows, columns = constant.object_shape
    columns_of = np.eye(rows * columns).reshape(-1, rows, columns)
    matrix = np.stack(
        [scipy.signal.convolve(each, lobe(0.7, 0.3), mode="valid", method="direct").ravel() for each in columns_of]
    )
    gradients = [np.diff(columns_of, axis=axis).reshape(rows * columns, -1) for axis in (1, 2)]
    normal = matrix @ matrix.T + 0.05 * sum(each @ each.T for each in gradients)
    expected = np.linalg.solve(normal, matrix @ image.ravel()).reshape(rows, columns)
    found = regularised(image, constant, strength=0.05, start=np.zeros((rows, columns)), iterations=500)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_each_point_has_its_own_pattern() -> None:
    varied = blur(varying)
    for x, y in ((10, 8), (45, 33), (83, 60)):
        scene = np.zeros(varied.object_shape)
        scene[y + REACH, x + REACH] = 1
        expected = np.zeros((SHAPE[0] + 2 * REACH, SHAPE[1] + 2 * REACH))
        expected[y : y + 2 * REACH + 1, x : x + 2 * REACH + 1] = varying(x, y)
        error = varied(scene) - expected[REACH:-REACH, REACH:-REACH]
        assert np.linalg.norm(error) < 0.02 * np.linalg.norm(expected)


@pytest.mark.parametrize("change", [1e-4, 0.02, 0.1])  # from one tile to many
def test_adjoint_has_equal_products(change: float) -> None:
    varied = blur(varying, change)
    scene, image = RNG.random(varied.object_shape), RNG.random(SHAPE)
    assert np.vdot(image, varied(scene)) == pytest.approx(np.vdot(varied.adjoint(image), scene), rel=1e-12)


def test_light_is_conserved() -> None:
    varied = blur(varying)
    scene = np.zeros(varied.object_shape)
    scene[2 * REACH : -2 * REACH, 2 * REACH : -2 * REACH] = RNG.random((SHAPE[0] - 2 * REACH, SHAPE[1] - 2 * REACH))
    assert varied(scene).sum() == pytest.approx(scene.sum(), rel=1e-9)


def test_positions_beyond_the_known_part_have_its_nearest_pattern() -> None:
    asked: list[tuple[float, float]] = []

    def psf_at(x_px: float, y_px: float) -> np.ndarray[Any, Any]:
        asked.append((x_px, y_px))
        return varying(x_px, y_px)

    varied = blur(psf_at, known_px=((20, 50), (30, 70)))
    assert min(x for x, _ in asked) >= 29
    assert max(x for x, _ in asked) <= 71
    scene = np.zeros(varied.object_shape)
    scene[40 + REACH, 10 + REACH] = 1
    assert np.abs(varied(scene)[34:47, 4:17] - varying(30, 40)).max() < 0.002


def test_richardson_lucy_ends_where_only_noise_is_left() -> None:
    varied = blur(varying)
    y, x = np.indices(varied.object_shape)
    scene = 200.0 * (1 + np.sin(x / 4) * np.sin(y / 5)) + 20
    image = np.asarray(RNG.poisson(varied(scene)), np.float64)
    noise, counted = CameraNoise(1.0, 0.0), np.ones(SHAPE, np.bool_)
    found = restored(image, varied, "richardson-lucy", noise=noise, counted=counted, iterations=300)
    assert 2 < found.iterations < 300
    assert 0.9 < found.chi_square <= 1
    one_less = restored(image, varied, "richardson-lucy", noise=noise, counted=counted, iterations=found.iterations - 1)
    assert one_less.chi_square > 1
    inner = scene[REACH:-REACH, REACH:-REACH]
    assert np.linalg.norm(found.image - inner) < 0.5 * np.linalg.norm(image - inner)


def test_edges_do_not_ring() -> None:
    """A uniform scene stays uniform up to the edge, although light from beyond it arrives."""
    varied = blur(varying)
    image = varied(np.full(varied.object_shape, 100.0))
    found = restored(image, varied, "richardson-lucy", noise=None, counted=np.ones(SHAPE, np.bool_), iterations=50)
    np.testing.assert_allclose(found.image, 100, rtol=0.05)
    np.testing.assert_allclose(found.image[REACH:-REACH, REACH:-REACH], 100, rtol=0.01)
