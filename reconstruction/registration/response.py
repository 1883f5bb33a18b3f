"""Linear response of the registration to local wavefronts, computed with a model of one lenslet.

A warp moves a blurred image, while diffraction blurs the moved one: the displacement found differs from the mean
gradient of the wavefront by an amount that is linear in the wavefront. The response replaces the mean gradients in the
modal reconstruction, like the synthetic interaction matrix of an adaptive optics system. The model has the source that
the reference shows, and each lenslet's coma and trefoil: their blur is not symmetric, which shows in its subimage. A
symmetric blur tells only the size of its cause, not its sign.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls

from reconstruction.arrays import Floats, Image
from reconstruction.displacement import TRANSMISSION_MODES
from reconstruction.errors import ReconstructionError
from reconstruction.frame.spline import mean_interpolation, sample
from reconstruction.registration.gauss_newton import GaussNewton, OwnWave
from reconstruction.registration.subimages import LensletModel, ReferenceSubimages

_DEGREE = 4  # of the local wavefronts
_SUM = np.add.outer(range(_DEGREE + 1), range(_DEGREE + 1))
_CHANGES = (_SUM % 2 == 1) & (_SUM <= _DEGREE)  # (n, m) of those that change an image
_OWN_DEGREE = 3
OWN_WAVES = [(n, _OWN_DEGREE - n) for n in range(_OWN_DEGREE + 1)]  # (n, m) of P_m(xi) P_n(eta)
_ALIGNMENTS = 2
_SQUARE_OVER_MEDIAN = 2.2  # mean of squares over their median, if normally distributed
_MISFIT = 0.1  # largest difference of modelled and measured reference, over its contrast


def fitting_model(make: Callable[[ReferenceSubimages], LensletModel], reference: ReferenceSubimages) -> LensletModel:
    """Make the model of a reference's lenslets; `ReconstructionError` if it does not fit the reference."""
    model, (subimage, _) = make(reference), mean_subimage(reference)
    misfit = float(np.std(model.image() - subimage) / np.std(subimage))
    if not misfit < _MISFIT:
        raise ReconstructionError(
            f"the modelled reference differs from the measured one by {100 * misfit:.0f} % of its contrast"
        )
    return model


def linear_response(registration: GaussNewton, reference: ReferenceSubimages, model: LensletModel) -> Floats:
    """Parameters of each lenslet's warp caused by local wavefronts P_m(xi) P_n(eta) T_q, to first order.

    They are px per rad, (lenslet, n, m, field_mode, K).
    """
    x, y = model.position.T
    modes = registration.modes
    values, gradients = modes.values(x, y), modes.gradients(x, y)
    derivatives = model.derivatives(_DEGREE, values, gradients)
    own_image = own_wave_images(model)
    own = [
        OwnWave(rad, image, model.derivatives(_DEGREE, values, gradients, wave)[_CHANGES])
        for wave, rad, image in zip(OWN_WAVES, own_waves(reference, own_image), own_image, strict=True)
    ]
    response = np.zeros((len(reference.light), *derivatives.shape[:3], len(registration.parameters)))
    response[:, _CHANGES] = registration.response(model.image(), derivatives[_CHANGES], own)
    return response


def own_wave_images(model: LensletModel) -> Floats:
    """Change of the image per rad of each of `OWN_WAVES`, (wave, row, column)."""
    points = len(model.position)
    found = model.derivatives(_OWN_DEGREE, np.ones((1, points)), np.zeros((1, points, 2)))
    return np.stack([found[*wave, 0] for wave in OWN_WAVES])


def own_waves(reference: ReferenceSubimages, images: Floats) -> Floats:
    """Wavefronts P_m(xi) P_n(eta) of `OWN_WAVES` that each lenslet has of its own, rad, (wave, L).

    From the images (wave, row, column) of one rad. A subimage differs from the mean one by them and by what is no
    wavefront: displacement, offset, and brightness that varies over the field. They are drawn towards zero as
    their noise demands, which the residual tells.
    """
    lit, blur = reference.lit, mean_interpolation(reference.width)[0]
    mean, _ = mean_subimage(reference)
    u, v = reference.offset_px.T / reference.half_width_px
    known = np.concatenate(
        [
            [part.ravel() for part in np.gradient(mean)[::-1]],
            mean.ravel() * TRANSMISSION_MODES.values(u, v),
            np.full((1, u.size), mean.mean()),
            (blur @ images @ blur.T).reshape(len(images), -1),
        ]
    )
    fit, light, moved_px = np.linalg.pinv(known), reference.light[lit], np.zeros(2)
    fitted = light @ fit
    for _ in range(_ALIGNMENTS):  # else a displacement of a pixel would be taken for coma
        moved_px = moved_px - fitted[:, :2] / fitted[:, 2:3]
        position_px = reference.position_px[lit] + (moved_px @ reference.turn)[:, None]
        edge = np.array(reference.coefficients.shape[::-1]) - 1
        light, _ = sample(reference.coefficients, np.clip(position_px, 0, edge))
        fitted = light @ fit
    square = np.mean((light - fitted @ known) ** 2, axis=1, keepdims=True)
    of_noise = square * np.sum(fit**2, axis=0)
    gain = fitted[:, 2:3]
    rad, variance = (fitted / gain)[:, -len(images) :].T, (of_noise / gain**2)[:, -len(images) :].T
    usual = np.maximum(_SQUARE_OVER_MEDIAN * np.median(rad**2 - variance, axis=1, keepdims=True), 0.0)
    found = np.zeros((len(images), lit.size))
    found[:, lit] = rad * usual / (usual + variance)
    return found


# SciPy's default of 3 is too small, e.g. if the lattice's rotation is off by a pixel at the edge.
_ITERATIONS_PER_POINT = 30


def mean_subimage(reference: ReferenceSubimages) -> tuple[Floats, Floats]:
    """Mean subimage of the lit lenslets, of unit sum, (width, width), and the light of each lenslet, counts.

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
    try:
        found, _ = nnls(matrix / scale, subimage.ravel(), maxiter=_ITERATIONS_PER_POINT * len(point_images))
    except RuntimeError as error:  # SciPy did not converge
        raise ReconstructionError("the source's shape cannot be found in the reference: is it in focus?") from error
    return np.asarray(found / scale)
