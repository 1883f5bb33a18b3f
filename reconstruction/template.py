"""What the Gauss-Newton steps of a warp need of the reference, computed once.

The steepest-descent images are taken from the reference instead of the frame: d(residual)/dc_q = d(I0 T_q)/dx. So
their pseudo-inverse does not depend on the frame, and a step is one product with the residual (after Baker and
Matthews 2004, International Journal of Computer Vision 56, 221).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruction.displacement import Mask
from reconstruction.field_modes import PolynomialModes
from reconstruction.geometry import Floats
from reconstruction.spline import Image
from reconstruction.subimages import ReferenceSubimages


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The reference as one warp sees it: L lenslets, N pixels a window, Q field modes."""

    offset_px: Image  # positions of the pixels about the lenslet centre, in the lattice frame, (N, xy)
    light: Image  # I0, counts, (L, N)
    basis: Image  # T_q and, per pixel, its derivatives along x and y, (3, Q, N); derivatives zero without flux
    inverse: Image  # pseudo-inverse of the steepest-descent images: x modes, y modes, gain, offset, (L, 2Q + 2, N)
    variance: Floats  # of each displacement coefficient per unit of pixel variance, (L, xy, Q)


def prepare_template(
    reference: ReferenceSubimages, modes: PolynomialModes, pixels: Mask, *, conserve_flux: bool
) -> Template:
    """Prepare the steps of the warp with the field modes T_q on some pixels (N,) of the windows.

    For d along x the steepest-descent images are d(I0 T_q)/dx = T_q dI0/dx + I0 dT_q/dx, of which the second term is
    the flux; those of gain and offset are I0 and 1.
    """
    lit, offset_px = reference.lit, reference.offset_px[pixels]
    light, gradient = reference.light[:, pixels], reference.gradient[:, pixels]
    x, y = offset_px.T / reference.half_width_px
    values = modes.values(x, y)
    slopes = modes.gradients(x, y) / reference.half_width_px * conserve_flux
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
    variance = np.zeros((len(light), 2, modes.count))
    variance[lit] = diagonal[:, : 2 * modes.count].reshape(-1, 2, modes.count)
    return Template(
        offset_px=offset_px.astype(np.float32),
        light=light.astype(np.float32),
        basis=np.stack([values, slopes[..., 0], slopes[..., 1]]).astype(np.float32),
        inverse=inverse,
        variance=variance,
    )
