"""Phase of a field without jumps of 2 pi, by least-squares integration of its wrapped differences.

D. C. Ghiglia and L. A. Romero, J. Opt. Soc. Am. A 11, 107 (1994): a Poisson equation with free edges, solved by the
discrete cosine transform. The result is then made congruent with the field's argument.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from reconstruction.arrays import Floats


def unwrapped_phase(field: NDArray[np.complex128]) -> Floats:
    """Phase (row, column), rad, of a field (row, column); its differences are right where they are below pi.

    Points of zero intensity, around which the phase winds, make it wrong by multiples of 2 pi.
    """
    gradient_y, gradient_x = np.angle(field[1:] * field[:-1].conj()), np.angle(field[:, 1:] * field[:, :-1].conj())
    divergence = np.diff(gradient_y, axis=0, prepend=0, append=0) + np.diff(gradient_x, axis=1, prepend=0, append=0)
    rows, columns = (2 * np.cos(np.pi * np.arange(count) / count) - 2 for count in field.shape)
    eigenvalues = rows[:, None] + columns
    eigenvalues[0, 0] = 1.0  # of the piston, which is set below
    phase = fft.idctn(fft.dctn(divergence) / eigenvalues)
    phase += np.angle(np.mean(field * np.exp(-1j * phase)))
    return np.asarray(phase + np.angle(field * np.exp(-1j * phase)), np.float64)
