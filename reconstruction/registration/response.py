"""Linear response of the registration to local wavefronts, computed with a model of one lenslet.

A warp moves a blurred image, while diffraction blurs the moved one: the displacement found differs from the mean
gradient of the wavefront by an amount that is linear in the wavefront. The response replaces the mean gradients in the
modal reconstruction, like the synthetic interaction matrix of an adaptive optics system.
"""

from typing import Protocol

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.registration.gauss_newton import GaussNewton
from reconstruction.registration.source_brightness import mean_subimage
from reconstruction.registration.subimages import ReferenceSubimages

_DEGREE = 4  # of the local wavefronts
_MISFIT = 0.1  # largest difference of modelled and measured reference, over its contrast


class LensletModel(Protocol):
    """Forward model of one lenslet with the measured source, on the window of a subimage."""

    position: Floats  # of the object points, normalised, (point, xy)

    def image(self) -> Floats:
        """Image without a sample, (row, column), a share of the lenslet's light."""
        ...

    def derivatives(self, degree: int, values: Floats, gradients: Floats) -> Floats:
        """Change of `image` per rad of the wavefronts P_m(xi) P_n(eta) T_q over the lenslet, m + n <= degree.

        From T_q at the object points, (field_mode, point), and its normalised gradients, (field_mode, point, xy), to
        (n, m, field_mode, row, column).
        """
        ...


def linear_response(registration: GaussNewton, reference: ReferenceSubimages, model: LensletModel) -> Floats:
    """Parameters of each lenslet's warp caused by local wavefronts P_m(xi) P_n(eta) T_q, to first order.

    Returns
    -------
    (lenslet, n, m, field_mode, K)
        px per rad.

    Raises
    ------
    ReconstructionError
        If the model does not fit the reference.
    """
    subimage, _ = mean_subimage(reference)
    image = model.image()
    misfit = float(np.std(image - subimage) / np.std(subimage))
    if not misfit < _MISFIT:
        raise ReconstructionError(
            f"the modelled reference differs from the measured one by {100 * misfit:.0f} % of its contrast"
        )
    x, y = model.position.T
    modes = registration.modes
    return registration.response(image, model.derivatives(_DEGREE, modes.values(x, y), modes.gradients(x, y)))
