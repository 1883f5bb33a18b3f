"""Pupil modes as local wavefronts: Legendre polynomials over each lenslet."""

import numpy as np
from numpy.polynomial import legendre as series

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor


def local_wavefronts(products: Floats, sensor: Sensor, degree: int) -> Floats:
    """Project pupil modes on the products P_m(xi) P_n(eta) over each lenslet.

    Parameters
    ----------
    products : (pupil_mode, n, m)
        The modes as sums of products over the whole lattice, see `PupilModes`.
    sensor : Sensor
        xi and eta are -1 ... 1 over the square around the aperture of a lenslet.
    degree : int
        Highest local m and n.

    Returns
    -------
    (lenslet_row, lenslet_column, n, m, pupil_mode)
        Coefficients of the local polynomials.
    """
    highest = products.shape[1] - 1
    nodes, weights = np.polynomial.legendre.leggauss((highest + degree) // 2 + 1)
    project = series.legvander(nodes, degree) * weights[:, None] * (np.arange(degree + 1) + 0.5)  # (node, local)

    def in_cells(center_m: Floats, half_width_m: float) -> Floats:
        at = (center_m[:, None] + nodes * sensor.aperture_width_m / 2) / half_width_m
        return np.asarray(np.einsum("cik,ij->cjk", series.legvander(at, highest), project))  # (cell, local, k)

    half_x_m, half_y_m = sensor.pupil_half_width_m
    along_y = in_cells(sensor.pupil_y_m, half_y_m)
    rows_of_x = sensor.lenslet_centers_m[:2, :, 0]  # of even and of odd rows
    local = np.empty((len(along_y), rows_of_x.shape[1], degree + 1, degree + 1, len(products)))
    for first, x_m in enumerate(rows_of_x):
        along_x, some = in_cells(x_m, half_x_m), slice(first, None, 2)
        local[some] = np.einsum("pkl,rnk,cml->rcnmp", products, along_y[some], along_x, optimize=True)
    return local
