"""The functions in which displacements are written."""

from __future__ import annotations

import numpy as np

from reconstruction.displacement import Displacement, diagonal_covariance
from reconstruction.modes.field_modes import LegendreModes, SampledModes


def test_a_sampled_mode_is_one_at_its_node_and_zero_at_the_others() -> None:
    modes = SampledModes(np.array([-0.8, 0.0, 0.8]), np.array([-0.5, 0.5]))
    np.testing.assert_allclose(modes.values(*modes.nodes), np.eye(6), atol=1e-14)


def test_sampled_modes_carry_every_polynomial_of_their_degree() -> None:
    modes = SampledModes(np.array([-0.8, 0.0, 0.8]), np.array([-0.5, 0.5]))
    node_x, node_y = modes.nodes
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 30))
    coefficients = (1 + node_x - 2 * node_x**2) * (3 - node_y)
    np.testing.assert_allclose(coefficients @ modes.values(x, y), (1 + x - 2 * x**2) * (3 - y), atol=1e-12)


def test_the_mean_displacement_is_the_mean_over_the_field() -> None:
    shape = (2, 3)
    for modes in (LegendreModes(6), SampledModes(np.array([-0.8, 0.0, 0.8]), np.array([-0.8, 0.1, 0.8]))):
        coefficients = np.random.default_rng(1).normal(size=(*shape, modes.count, 2))
        known = diagonal_covariance(coefficients**2), np.zeros(shape, np.int8), *np.zeros((3, *shape))
        displacement = Displacement(modes, coefficients, *known)
        steps = np.linspace(-1, 1, 401)
        steps = (steps[1:] + steps[:-1]) / 2
        values = modes.values(*np.meshgrid(steps, steps)).mean(axis=(1, 2))
        np.testing.assert_allclose(displacement.mean, np.einsum("rcqv,q->rcv", coefficients, values), atol=1e-4)
