"""What the Gauss-Newton steps of a warp need of the reference, computed once.

The steepest-descent images are taken from the reference instead of the frame: d(residual)/dc_q = d(I0 T_q)/dx. So
their pseudo-inverse does not depend on the frame, and a step is one product with the residual (after Baker and
Matthews 2004, International Journal of Computer Vision 56, 221).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.geometry import Floats
from reconstruction.polynomials import legendre, legendre_gradients
from reconstruction.spline import Image


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The reference as one warp sees it: L lenslets, N pixels a window, Q field modes."""

    offset_px: Image  # positions of the pixels about the lenslet centre, in the lattice frame, (N, xy)
    light: Image  # I0, counts, (L, N)
    basis: Image  # T_q and, per pixel, its derivatives along x and y, (3, Q, N); derivatives zero without flux
    inverse: Image  # pseudo-inverse of the steepest-descent images: x modes, y modes, gain, offset, (L, 2Q + 2, N)
    variance: Floats  # of each displacement coefficient per unit of pixel variance, (L, xy, Q)


def prepare_template(
    light: Floats,
    gradient: Floats,
    *,
    lit: NDArray[np.bool_],
    offset_px: Image,
    half_width_px: float,
    modes: int,
    conserve_flux: bool,
) -> Template:
    """Prepare the steps of the warp with `modes` field modes T_q, for the lenslets that are lit (L,).

    light (L, N) and gradient (L, N, xy), per pixel, of the reference in windows at offset_px (N, xy). For d along x the
    steepest-descent images are d(I0 T_q)/dx = T_q dI0/dx + I0 dT_q/dx, of which the second term is the flux; those
    of gain and offset are I0 and 1.
    """
    x, y = offset_px.T.astype(np.float64) / half_width_px
    values = legendre(modes, x, y)
    slopes = legendre_gradients(modes, x, y) / half_width_px * conserve_flux
    descent = np.concatenate(
        [
            gradient[lit, None, :, 0] * values + light[lit, None] * slopes[..., 0],
            gradient[lit, None, :, 1] * values + light[lit, None] * slopes[..., 1],
            light[lit, None],
            np.ones((np.count_nonzero(lit), 1, light.shape[1])),
        ],
        axis=1,
    )
    norm = np.linalg.norm(descent, axis=2, keepdims=True)
    descent /= norm
    covariance = np.linalg.pinv(descent @ np.swapaxes(descent, 1, 2), rcond=1e-9, hermitian=True)
    inverse = np.zeros((len(light), *descent.shape[1:]), np.float32)
    inverse[lit] = covariance @ descent / norm
    diagonal = np.diagonal(covariance, axis1=1, axis2=2) / norm[..., 0] ** 2
    variance = np.zeros((len(light), 2, modes))
    variance[lit] = diagonal[:, : 2 * modes].reshape(-1, 2, modes)
    return Template(
        offset_px=offset_px,
        light=light.astype(np.float32),
        basis=np.stack([values, slopes[..., 0], slopes[..., 1]]).astype(np.float32),
        inverse=inverse,
        variance=variance,
    )
