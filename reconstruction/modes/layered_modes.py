"""Wavefronts of layered samples, in pupil modes R_p(u) times field modes T_q(x).

Straight rays through layers make phi(u, x) = sum_i Phi_i(a_i u + b_i x), so that
(d_u d_y - d_v d_x) phi = 0: subimages do not rotate (docs/methods.md).
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre as series
from scipy import linalg, sparse
from scipy.sparse.csgraph import connected_components

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.field_modes import FieldModes, PolynomialModes, gradient_basis
from reconstruction.modes.pupil_modes import PupilModes

_DEPENDENT = 1e-9  # of a row's largest element; independent rows leave 0.3
_ROTATES = 1e-5  # share of a rotation in a parameter of the warp, which is in single precision
_ROUNDING = 1e-10  # of a mode's largest coefficient; its derivatives have true ones far above


def layered_basis(pupil_products: Floats, field_products: Floats, scale: Floats, half_width: Floats) -> Floats:
    """Orthonormal basis of the layered wavefronts.

    Parameters
    ----------
    pupil_products : (pupil_mode, n, m)
        Pupil modes as sums of P_m(xi) P_n(eta), xi and eta over the lattice.
    field_products : (field_mode, b, a)
        Field modes as sums of P_a(x) P_b(y).
    scale : (pupil_mode, field_mode)
        Unit of each coefficient; the basis is orthonormal in these units.
    half_width : (xy,)
        Of the lattice, in any unit: xi and eta are u and v over it.

    Returns
    -------
    (pupil_mode * field_mode, n)
        Coefficients in the units of `scale`.
    """
    slope_u, slope_v = _derivatives(pupil_products)
    slope_x, slope_y = _derivatives(field_products)
    rotation = sparse.kron(slope_u / half_width[0], slope_y) - sparse.kron(slope_v / half_width[1], slope_x)
    rotation = sparse.csc_array(rotation.T * scale.ravel())
    # Modes of different symmetry do not mix: one small basis for each connected set.
    count, label = connected_components(abs(rotation).T @ abs(rotation), directed=False)
    places = [np.flatnonzero(label == block) for block in range(count)]
    blocks = [_null_space(rotation[:, place].toarray()) for place in places]
    basis = np.zeros((rotation.shape[1], sum(block.shape[1] for block in blocks)))
    first = 0
    for place, block in zip(places, blocks, strict=True):
        basis[place, first : first + block.shape[1]] = block
        first += block.shape[1]
    return basis


def layered_wavefronts(
    sensor: Sensor, modes: PupilModes, field_modes: FieldModes, parameters: Floats
) -> Callable[[Floats], Floats] | None:
    """`layered_basis` of a scale (pupil_mode - 1, field_mode), without piston; None if the warp (K, 2Q) may rotate."""
    if not isinstance(field_modes, PolynomialModes):
        return None
    gradients = gradient_basis(field_modes)
    if not np.allclose(parameters @ gradients.T @ gradients, parameters, atol=_ROTATES):
        return None
    half_width_m = np.array(sensor.pupil_half_width_m)

    def basis(scale: Floats) -> Floats:
        arrays = modes.products[1:], field_modes.products, scale, half_width_m
        return _cached_basis(tuple((array.shape, array.tobytes()) for array in arrays))

    return basis


@lru_cache(maxsize=16)
def _cached_basis(arrays: tuple[tuple[tuple[int, ...], bytes], ...]) -> Floats:
    """`layered_basis` of arrays given by shape and content: the same for every reference of a bench."""
    return layered_basis(*(np.frombuffer(content).reshape(shape) for shape, content in arrays))


def _null_space(rows: Floats) -> Floats:
    """Orthonormal basis (column, n) of the vectors that all rows (row, column) map to zero."""
    largest = np.abs(rows).max(axis=1)
    rows = rows[largest > 0] / largest[largest > 0, None]
    if not len(rows):
        return np.eye(rows.shape[1])
    unitary, triangle, _ = linalg.qr(rows.T, pivoting=True)
    rank = np.count_nonzero(np.abs(np.diag(triangle)) > _DEPENDENT)
    return np.asarray(unitary[:, rank:])


def _derivatives(products: Floats) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Derivatives of modes (mode, n, m) along x and y, as coefficients of products: each (mode, n * m)."""
    degree = products.shape[1] - 1
    derive = np.zeros((degree + 1, degree + 1))
    derive[: max(degree, 1), :] = series.legder(np.eye(degree + 1))
    along_x, along_y = products @ derive.T, np.swapaxes(np.swapaxes(products, 1, 2) @ derive.T, 1, 2)
    # Zernike modes have rounding errors in place of zeros, which would count as equations.
    least = _ROUNDING * np.abs(products).max(axis=(1, 2), keepdims=True)
    along_x, along_y = (np.where(np.abs(slope) > least, slope, 0.0) for slope in (along_x, along_y))
    return sparse.csr_array(along_x.reshape(len(products), -1)), sparse.csr_array(along_y.reshape(len(products), -1))
