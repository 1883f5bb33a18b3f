"""Linear response of the registration to local wavefronts, computed with a model of one lenslet.

A warp moves a blurred image, while diffraction blurs the moved one: the displacement found differs from the mean
gradient of the wavefront by an amount that is linear in the wavefront. The response replaces the mean gradients in the
modal reconstruction, like the synthetic interaction matrix of an adaptive optics system. The model has the source that
the reference shows, and the coma and trefoil of each lenslet.

Coma and trefoil blur a subimage of the reference without symmetry, which shows how large they are, and with which sign.
A symmetric blur, as that of defocus, shows only the size of its cause. What all lenslets have alike counts as the shape
of the source.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import scipy  # which loads its parts when they are used

from reconstruction.arrays import Floats, Image
from reconstruction.displacement import TRANSMISSION_MODES, RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.frame.spline import interpolate, mean_interpolation
from reconstruction.modes.field_modes import PolynomialModes
from reconstruction.registration.subimages import LensletModel, ReferenceSubimages

OWN_WAVEFRONTS = [(n, 3 - n) for n in range(4)]  # (n, m) of P_m(xi) P_n(eta)
_LEAST_LENSLETS = 16  # that tell how large own wavefronts usually are; with 4 of them, noise made errors larger
_ALIGNMENTS = 2
_SQUARE_OVER_MEDIAN = 2.2  # mean square over the median of the squares, if normally distributed


class OwnWavefront(NamedTuple):
    """A small wavefront that the lenslets have of their own, and what a rad of it does to subimages."""

    rad: Floats  # of each lenslet, (L,)
    image: Floats  # change of a subimage per rad, (row, column)
    changes: Floats  # change of what a sample changes, per rad of the lenslet and of the sample, (..., row, column)


class OwnWavefronts(NamedTuple):
    """Own wavefronts `OWN_WAVEFRONTS` of the lenslets, less their mean."""

    rad: Floats  # (wavefront, L); 0 where the lenslet is dark, or few are lit
    images: Floats  # changes of the model's image per rad, (wavefront, row, column)


def own_wavefronts(reference: ReferenceSubimages, model: LensletModel) -> OwnWavefronts:
    """Find the own wavefronts that a reference shows, with a model of its lenslets."""
    points = len(model.position)
    changes = model.derivatives(3, np.ones((1, points)), np.zeros((1, points, 2)))
    images = np.stack([changes[n, m, 0] for n, m in OWN_WAVEFRONTS])
    rad, lit = np.zeros((len(images), reference.lit.size)), reference.lit
    if np.count_nonzero(lit) >= _LEAST_LENSLETS:
        rad[:, lit] = [shrunk(*each) for each in zip(*_fitted(reference, images), strict=True)]
    return OwnWavefronts(rad, images)


def _fitted(reference: ReferenceSubimages, images: Floats) -> tuple[Floats, Floats]:
    """Own wavefronts of the lit lenslets and their variance by noise, (wavefront, lit lenslet).

    A subimage differs from the mean one by them and by what is no wavefront: displacement, offset, and brightness that
    varies over the field. The subimages are aligned first: a displacement of a pixel would look like coma, and blur
    the mean.
    """
    blur, _ = mean_interpolation(reference.width)
    own_images = (blur @ images @ blur.T).reshape(len(images), -1)
    brightness = TRANSMISSION_MODES.values(*reference.offset_px.T / reference.half_width_px)
    edge = np.array(reference.spline_coefficients.shape[::-1]) - 1
    light, moved_px = reference.light[reference.lit], np.zeros(2)
    for alignment in range(_ALIGNMENTS + 1):
        mean = np.sum(light, axis=0) / np.sum(light)
        along_y, along_x = (part.ravel() for part in np.gradient(mean.reshape(reference.width, -1)))
        differences = np.stack([*mean * brightness, along_x, along_y, np.full_like(mean, mean.mean()), *own_images])
        fit = np.linalg.pinv(differences)  # (pixel, number)
        fitted = light @ fit
        gain, shift = fitted[:, :1], fitted[:, len(brightness) :][:, :2]
        if alignment < _ALIGNMENTS:
            moved_px = moved_px - shift / gain
            position_px = reference.position_px[reference.lit] + (moved_px @ reference.turn)[:, None]
            light, _ = interpolate(reference.spline_coefficients, np.clip(position_px, 0, edge))
    variance = (light - fitted @ differences) ** 2 @ fit**2
    return (fitted / gain)[:, -len(images) :].T, (variance / gain**2)[:, -len(images) :].T


def shrunk(values: Floats, variance: Floats) -> Floats:
    """Shrink measured values (n,), which scatter about 0, towards 0 according to their variance (n,).

    How much the true values scatter follows from the median of the measured squares, which bears outliers.
    """
    scatter = max(_SQUARE_OVER_MEDIAN * float(np.median(values**2)) - float(np.median(variance)), 0.0)
    return values * (scatter / np.maximum(scatter + variance, np.finfo(np.float64).tiny))


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
        most = _ITERATIONS_PER_POINT * len(point_images)
        found, _ = scipy.optimize.nnls(equations[:, :-1], equations[:, -1], maxiter=most)
    except RuntimeError as error:  # SciPy did not converge
        raise ReconstructionError("the source's shape cannot be found in the reference: is it in focus?") from error
    return np.asarray(found / scale)
