"""Field modes T_q, in which the displacement of a lenslet is written: d(x, y) = sum_q c_q T_q(x, y).

Positions are normalised: x, y in [-1, 1] over the half width of the field.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.modes.polynomials import (
    legendre,
    legendre_gradients,
    legendre_products,
    number_up_to,
    zernike,
    zernike_gradients,
    zernike_products,
)


class _Family(NamedTuple):
    """Polynomials of two variables, of which d + 1 have the degree d, by degree."""

    products: Callable[[int], Floats]
    values: Callable[[int, ArrayLike, ArrayLike], Floats]
    gradients: Callable[[int, ArrayLike, ArrayLike], Floats]


@dataclass(frozen=True, slots=True)
class PolynomialModes:
    """The first `count` polynomials of a family: modes with gradients, as a warp needs them."""

    count: int
    _family: ClassVar[_Family]

    @property
    def degree(self) -> Floats:
        """Degree of each polynomial, (field_mode,)."""
        return np.floor((np.sqrt(8 * np.arange(self.count) + 1) - 1) / 2)

    @property
    def products(self) -> Floats:
        """T_q as sums of products P_a(x) P_b(y): (field_mode, b, a)."""
        return self._family.products(self.count)

    def values(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """T_q at normalised positions: (field_mode, *broadcast shape)."""
        return self._family.values(self.count, x, y)

    def gradients(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Gradients of T_q per unit of x and y: (field_mode, *broadcast shape, xy)."""
        return self._family.gradients(self.count, x, y)


class LegendreModes(PolynomialModes):
    """The first `count` products of Legendre polynomials, for a square field."""

    __slots__ = ()
    _family = _Family(legendre_products, legendre, legendre_gradients)


class ZernikeModes(PolynomialModes):
    """The first `count` Zernike polynomials, for a circular field."""

    __slots__ = ()
    _family = _Family(zernike_products, zernike, zernike_gradients)


def orthogonal_modes(field: Field, count: int) -> PolynomialModes:
    """Return the first `count` polynomials that are orthogonal over a field."""
    return (ZernikeModes if field.shape == "circle" else LegendreModes)(count)


def gradient_basis(modes: PolynomialModes) -> Floats:
    """Displacements in the span of some field modes that are gradients of a potential over the field.

    Straight rays through layers make no others: a subimage shears and stretches, but does not rotate. Q field modes
    span all polynomials up to a degree. The coefficients (parameter, 2Q), x modes and then y modes, are orthonormal;
    there are 2, 5, 9, 14, 20 for Q = 1, 3, 6, 10, 15.
    """
    degree = round((math.sqrt(8 * modes.count + 1) - 3) / 2)
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)))
    potentials = legendre_gradients(number_up_to(degree + 1), x, y)[1:]  # without the constant
    to_modes = np.linalg.pinv(modes.values(x, y))
    coefficients = np.concatenate([potentials[..., 0] @ to_modes, potentials[..., 1] @ to_modes], axis=1)
    return np.asarray(np.linalg.qr(coefficients.T)[0].T)


@dataclass(frozen=True, slots=True, eq=False)
class SampledModes:
    """Lagrange polynomials of a grid of all x and y, row by row: c_q is the displacement at node q."""

    x: Floats  # normalised, (column,)
    y: Floats  # normalised, (row,)

    @property
    def count(self) -> int:
        """Number of nodes."""
        return self.x.size * self.y.size

    @property
    def degree(self) -> Floats:
        """Zero for each node, (field_mode,): all are alike."""
        return np.zeros(self.count)

    @property
    def nodes(self) -> tuple[Floats, Floats]:
        """Normalised x and y of every node, (field_mode,) each."""
        y, x = np.meshgrid(self.y, self.x, indexing="ij")
        return x.ravel(), y.ravel()

    def values(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """T_q at normalised positions: (field_mode, *broadcast shape)."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        products = _lagrange(self.y, y)[:, None] * _lagrange(self.x, x)[None, :]
        return products.reshape(self.count, *x.shape)


def _lagrange(nodes: Floats, x: Floats) -> Floats:
    """Lagrange polynomials of the nodes (node,) at x: (node, *shape of x)."""
    polynomials = []
    for index, node in enumerate(nodes):
        others = np.delete(nodes, index)
        factors = [(x - other) / (node - other) for other in others]
        polynomials.append(np.prod(factors, axis=0) if factors else np.ones_like(x))
    return np.stack(polynomials)


FieldModes: TypeAlias = PolynomialModes | SampledModes
"""Functions T_q of the field position."""
