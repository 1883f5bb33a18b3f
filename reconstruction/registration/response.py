"""Linear response of the registration to local wavefronts, computed with a model of one lenslet.

A warp moves a blurred image, while diffraction blurs the moved one: the displacement found differs from the mean
gradient of the wavefront by an amount that is linear in the wavefront. The response replaces the mean gradients in the
modal reconstruction, like the synthetic interaction matrix of an adaptive optics system. The model has the source that
the reference shows, and the coma and trefoil of each lenslet.
"""

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import scipy  # which loads its parts when they are used

from reconstruction.arrays import Floats, Image
from reconstruction.displacement import RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import PolynomialModes
from reconstruction.registration.own_wavefronts import OWN_WAVEFRONTS, OwnWavefront, own_wavefronts
from reconstruction.registration.subimages import LensletModel, ReferenceSubimages

_DEGREE = 4  # of the local wavefronts
_SUM = np.add.outer(range(_DEGREE + 1), range(_DEGREE + 1))
_SHOWS = (_SUM % 2 == 1) & (_SUM <= _DEGREE)  # (n, m) of those that change an image
_MISFIT = 0.1  # largest difference of modelled and measured reference, over its contrast


@runtime_checkable
class WarpRegistration(RegistrationMethod, Protocol):
    """A registration that fits warps, and knows what it finds for small changes of a subimage."""

    reference: ReferenceSubimages
    modes: PolynomialModes
    parameters: Floats  # displacement (x modes, y modes) of each parameter of the warp, (K, 2Q)
    alike: Floats  # from any displacement (x modes, y modes) to the parameters of one that looks alike, (K, 2Q)
    hidden: int  # number of displacements of the warp that the reference hardly shows, and which are left out
    brightness_terms: int  # number of polynomials over the field that are taken out as a brightness

    def response(self, image: Floats, changes: Floats, own: Sequence[OwnWavefront] = ()) -> Floats:
        """Parameters found for small changes of a subimage, to first order.

        From a noise-free subimage (row, column) and its changes (..., row, column), in any unit, to (lenslet, ..., K),
        px. `own` are wavefronts that the lenslets have without a sample.
        """
        ...


def fitting_model(make: Callable[[ReferenceSubimages], LensletModel], reference: ReferenceSubimages) -> LensletModel:
    """Make the model of a reference's lenslets; `ReconstructionError` if it does not fit the reference."""
    model, (subimage, _) = make(reference), mean_subimage(reference)
    misfit = float(np.std(model.image() - subimage) / np.std(subimage))
    if not misfit < _MISFIT:
        raise ReconstructionError(
            f"the modelled reference differs from the measured one by {100 * misfit:.0f} % of its contrast"
        )
    return model


def linear_response(registration: WarpRegistration, model: LensletModel) -> Floats:
    """Parameters of each lenslet's warp caused by local wavefronts P_m(xi) P_n(eta) T_q, to first order.

    They are px per rad, (lenslet, n, m, field_mode, K).
    """
    x, y = model.position.T
    modes = registration.modes
    values, gradients = modes.values(x, y), modes.gradients(x, y)
    derivatives = model.derivatives(_DEGREE, values, gradients)
    rad, images = own_wavefronts(registration.reference, model)
    own = [
        OwnWavefront(of_lenslets, image, model.derivatives(_DEGREE, values, gradients, order)[_SHOWS])
        for order, of_lenslets, image in zip(OWN_WAVEFRONTS, rad, images, strict=True)
    ]
    response = np.zeros((rad.shape[1], *derivatives.shape[:3], len(registration.parameters)))
    response[:, _SHOWS] = registration.response(model.image(), derivatives[_SHOWS], own)
    return response


# SciPy's default of 3 is too small, e.g. if the lattice's rotation is off by a pixel at the edge.
_ITERATIONS_PER_POINT = 30


def mean_subimage(reference: ReferenceSubimages) -> tuple[Floats, Floats]:
    """Mean subimage of lit lenslets, of unit sum, (width, width), and the light of each, counts.

    The light is (lenslet_row, lenslet_column); 0 where the lenslet is dark. `ReconstructionError` if there is none.
    """
    light = np.where(reference.lit, np.sum(reference.light, axis=1), 0.0)
    light = np.maximum(light, 0.0)
    total = np.sum(light)
    if not total > 0:
        raise ReconstructionError("the reference has no light above its background: is the dark brighter?")
    mean = np.sum(reference.light[reference.lit], axis=0) / total
    return mean.reshape(reference.width, reference.width), light.reshape(reference.lenslets)


def point_brightness(point_images: Image, subimage: Floats) -> Floats:
    """Non-negative brightness (point,) whose point images (point, row, column) add up to a subimage."""
    matrix = point_images.reshape(len(point_images), -1).T.astype(np.float64)
    scale = np.max(matrix)  # the solver's tolerance is absolute
    # The same least squares with as many equations as points: there are fewer than pixels.
    augmented = np.column_stack([matrix / scale, subimage.ravel()])
    equations = np.asarray(np.linalg.qr(augmented, mode="r"))[: len(point_images)]
    try:
        found, _ = scipy.optimize.nnls(
            equations[:, :-1], equations[:, -1], maxiter=_ITERATIONS_PER_POINT * len(point_images)
        )
    except RuntimeError as error:  # SciPy did not converge
        raise ReconstructionError("the source's shape cannot be found in the reference: is it in focus?") from error
    return np.asarray(found / scale)
