"""Pupil modes from any polynomials, for bases of other people."""

from typing import Any, TypeAlias

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Mask
from reconstruction.geometry import Sensor
from reconstruction.modes.pupil_modes import PupilModes, aperture_means

Values: TypeAlias = NDArray[np.floating[Any]]

_NONE = 1e-12  # coefficient of a polynomial, of its largest, that is rounding


def polynomial_modes(sensor: Sensor, products: Floats, inside: Mask | None = None) -> PupilModes:
    """Make pupil modes of polynomials.

    Parameters
    ----------
    sensor : Sensor
        Its lattice is the pupil.
    products : (pupil_mode, n, m)
        The modes as sums of products P_n(eta) P_m(xi) of Legendre polynomials, xi (along x) and eta (along y) from -1
        to 1 over the whole lattice; the first is the piston. Degrees n + m up to 16 are exact.
    inside : bool (lenslet_row, lenslet_column), optional
        Lenslets inside the pupil; all by default.

    Raises
    ------
    ValueError
        If the first mode is not the piston.
    """
    is_part = np.abs(products) > _NONE * np.abs(products).max(axis=(1, 2), keepdims=True)
    if np.flatnonzero(is_part[0]).tolist() != [0]:
        raise ValueError("the first pupil mode must be the piston, a constant")
    half_m, highest = np.array(sensor.pupil_half_width_m), products.shape[1] - 1
    derive = series.legder(np.eye(highest + 1)) if highest else np.zeros((1, 1))

    def summed(along_y: Values, along_x: Values) -> Floats:
        return np.asarray(np.einsum("pnm,...n,...m->p...", products, along_y, along_x, optimize=True))

    def gradients(x: Floats, y: Floats) -> Floats:
        (along_x, slope_x), (along_y, slope_y) = (
            (series.legvander(at, highest), series.legvander(at, len(derive) - 1) @ derive) for at in (x, y)
        )
        return np.stack([summed(along_y, slope_x), summed(slope_y, along_x)], axis=-1)

    x, y = np.moveaxis(sensor.lenslet_centers_m / half_m, -1, 0)
    n, m = np.indices(products.shape[1:])
    return PupilModes(
        values=summed(series.legvander(y, highest), series.legvander(x, highest)),
        gradients=aperture_means(gradients, sensor, half_m) / half_m,
        inside=np.ones(x.shape, np.bool_) if inside is None else inside,
        degree=np.max((n + m) * is_part, axis=(1, 2)).astype(np.float64),
        products=products,
    )
