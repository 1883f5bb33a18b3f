"""Pupil modes as local wavefronts: Legendre polynomials over each lenslet."""

import numpy as np
from numpy.polynomial import legendre as series

from reconstruction.arrays import Floats


def local_wavefronts(products: Floats, lenslet_rows: int, lenslet_columns: int, degree: int) -> Floats:
    """Project pupil modes on the products P_m(xi) P_n(eta) over each lenslet, xi and eta in [-1, 1].

    Parameters
    ----------
    products : (pupil_mode, n, m)
        The modes as sums of products over the whole lattice, see `PupilModes`.
    lenslet_rows, lenslet_columns : int
        The lenslets tile the lattice.
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

    def in_cells(cells: int) -> Floats:
        center = (2 * np.arange(cells) + 1 - cells) / cells
        values = series.legvander(center[:, None] + nodes / cells, highest)  # (cell, node, k)
        return np.asarray(np.einsum("cik,ij->cjk", values, project))

    along_x, along_y = in_cells(lenslet_columns), in_cells(lenslet_rows)
    return np.asarray(np.einsum("pkl,rnk,cml->rcnmp", products, along_y, along_x, optimize=True))
