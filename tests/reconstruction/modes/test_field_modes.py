"""Field modes."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.displacement import Displacement, diagonal_covariance
from reconstruction.modes.field_modes import LegendreModes, SampledModes, ZernikeModes, gradient_basis


def test_sampled_mode_is_one_at_its_node_and_zero_at_others() -> None:
    modes = SampledModes(np.array([-0.8, 0.0, 0.8]), np.array([-0.5, 0.5]))
    np.testing.assert_allclose(modes.values(*modes.nodes), np.eye(6), atol=1e-14)


def test_sampled_modes_reproduce_polynomials_of_their_degree() -> None:
    modes = SampledModes(np.array([-0.8, 0.0, 0.8]), np.array([-0.5, 0.5]))
    node_x, node_y = modes.nodes
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 30))
    coefficients = (1 + node_x - 2 * node_x**2) * (3 - node_y)
    np.testing.assert_allclose(coefficients @ modes.values(x, y), (1 + x - 2 * x**2) * (3 - y), atol=1e-12)


def test_mean_displacement_is_mean_over_field() -> None:
    shape = (2, 3)
    for modes in (LegendreModes(6), SampledModes(np.array([-0.8, 0.0, 0.8]), np.array([-0.8, 0.1, 0.8]))):
        coefficients = np.random.default_rng(1).normal(size=(*shape, modes.count, 2))
        known = diagonal_covariance(coefficients**2), np.zeros(shape, np.int8), *np.zeros((3, *shape))
        displacement = Displacement(modes, coefficients, *known)
        steps = np.linspace(-1, 1, 401)
        steps = (steps[1:] + steps[:-1]) / 2
        values = modes.values(*np.meshgrid(steps, steps)).mean(axis=(1, 2))
        np.testing.assert_allclose(displacement.mean, np.einsum("rcqv,q->rcv", coefficients, values), atol=1e-4)


@pytest.mark.parametrize(("count", "parameters"), [(1, 2), (3, 5), (6, 9), (10, 14), (15, 20)])
@pytest.mark.parametrize("kind", [LegendreModes, ZernikeModes])
def test_gradient_basis_spans_all_gradients_and_has_no_circulation(
    kind: type[LegendreModes | ZernikeModes], count: int, parameters: int
) -> None:
    modes = kind(count)
    basis = gradient_basis(modes)
    assert basis.shape == (parameters, 2 * count)
    np.testing.assert_allclose(basis @ basis.T, np.eye(parameters), atol=1e-12)
    x, y = np.random.default_rng(2).uniform(-0.7, 0.7, (2, 40))
    slopes = modes.gradients(x, y)
    curl = basis[:, count:] @ slopes[..., 0] - basis[:, :count] @ slopes[..., 1]
    np.testing.assert_allclose(curl, 0, atol=1e-10)
    values = modes.values(x, y)
    fields = np.concatenate([basis[:, :count] @ values, basis[:, count:] @ values], axis=1)
    degree = {1: 1, 3: 2, 6: 3, 10: 4, 15: 5}[count]
    powers = [(m, n) for m in range(6) for n in range(6) if 0 < m + n <= degree]
    assert len(powers) == parameters
    for m, n in powers:  # the potential x^m y^n
        gradient = np.concatenate([m * x ** max(m - 1, 0) * y**n, n * x**m * y ** max(n - 1, 0)])
        fitted = fields.T @ np.linalg.lstsq(fields.T, gradient)[0]
        np.testing.assert_allclose(fitted, gradient, atol=1e-10)
