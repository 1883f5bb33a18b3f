"""Fisher information of a frame about the wavefront, and the Cramer-Rao bound.

A pixel with light I and variance V adds (dI/da)(dI/db) / V to the information about a and b. The derivatives are those
of a model of one lenslet. The offset of each subimage is unknown, too, and the brightness of its source over the field.
"""

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.layered_modes import layered_basis
from reconstruction.modes.pupil_modes import PupilModes, local_wavefronts
from reconstruction.registration.subimages import LensletModel

GAIN_ALONE = LegendreModes(1)  # brightness of a source that changes everywhere alike
_DEGREE = 5  # of the local wavefronts
_LIGHT_STEP = 0.05  # relative; the information of one lenslet is computed once per step and scaled by the light


def layered_information(
    model: LensletModel,
    light: Floats,
    noise: CameraNoise,
    *,
    sensor: Sensor,
    modes: PupilModes,
    field_modes: LegendreModes,
    brightness: LegendreModes = GAIN_ALONE,
) -> tuple[Floats, Floats]:
    """Fisher information of a frame about layered wavefronts, near the reference.

    Parameters
    ----------
    light : (lenslet_row, lenslet_column)
        Light of each lenslet, counts; 0 where it is lost.
    noise : CameraNoise
        Of the frame.
    modes, field_modes
        R_p, piston first, and T_q.
    brightness : LegendreModes
        Polynomials over the field in which the brightness of each subimage's source is unknown.

    Returns
    -------
    information : (n, n)
        About the coefficients of the basis, 1/rad^2.
    basis : (pupil_mode - 1, field_mode, n)
        Coefficients e_pq, rad, of each layered wavefront.
    """
    products = modes.products[1:]
    x, y = model.position.T
    derivatives = model.derivatives(_DEGREE, field_modes.values(x, y), field_modes.gradients(x, y))
    n, m = np.nonzero(np.any(derivatives, axis=(2, 3, 4)))
    derivatives, image = derivatives[n, m], model.image()
    varied = np.stack([model.image(values) for values in brightness.values(x, y)])
    local = local_wavefronts(products, sensor, _DEGREE)[:, :, n, m]
    local, of_lenslet = local.reshape(light.size, -1), light.ravel()  # (lenslet, local * pupil_mode), (lenslet,)
    step = np.rint(np.log(np.maximum(of_lenslet, np.finfo(np.float64).tiny)) / _LIGHT_STEP)
    total = np.zeros((len(products), field_modes.count) * 2)
    for level in np.unique(step[of_lenslet > 0]):
        alike = (step == level) & (of_lenslet > 0)
        usual = float(np.mean(of_lenslet[alike]))
        weighted = (local[alike].T * (of_lenslet[alike] / usual)) @ local[alike]
        weighted = weighted.reshape((len(n), len(products)) * 2)
        information = lenslet_information(image * usual, derivatives * usual, noise, varied)
        total += np.einsum("jpkr,jqks->pqrs", weighted, information, optimize=True)
    scale = np.ones(total.shape[:2])
    basis = layered_basis(products, field_modes.products, scale, np.array(sensor.pupil_half_width_m))
    return basis.T @ total.reshape(len(basis), -1) @ basis, basis.reshape(*scale.shape, -1)


def lenslet_information(light: Floats, derivatives: Floats, noise: CameraNoise, varied: Floats) -> Floats:
    """Fisher information of one subimage about local wavefronts, where offset and brightness are unknown.

    From its light (row, column), counts, the derivatives (local, field_mode, row, column), counts per rad, and the
    changes by an unknown brightness (change, row, column), in any unit, to (local, field_mode, local, field_mode),
    1/rad^2.
    """
    sigma = np.sqrt(noise.variance(light)).ravel()
    unknown = np.stack([*varied.reshape(len(varied), -1), np.ones(light.size)], axis=1) / sigma[:, None]
    unknown, _ = np.linalg.qr(unknown)
    changes = derivatives.reshape(-1, light.size) / sigma
    changes -= (changes @ unknown) @ unknown.T
    return np.asarray((changes @ changes.T).reshape(derivatives.shape[:2] * 2))


def wavefront_bound(
    information: Floats, basis: Floats, field: Field, modes: PupilModes, field_modes: LegendreModes
) -> Floats:
    """Cramer-Rao bound of the views: standard deviation of the best unbiased estimator.

    `information` and `basis` are from `layered_information`. The bound is (view_row, view_column, lenslet_row,
    lenslet_column), rad, without piston. `ReconstructionError` if the frame carries no information about some
    wavefronts.
    """
    try:
        root = np.linalg.inv(np.linalg.cholesky(information))
    except np.linalg.LinAlgError as error:
        raise ReconstructionError("the frame carries no information about some of the wavefronts") from error
    at_views = field_modes.values(field.view_x_m / field.half_width_m, field.view_y_m[:, None] / field.half_width_m)
    values = modes.values[1:] - modes.values[1:].mean(axis=(1, 2), keepdims=True)
    per_view = np.tensordot(at_views, basis @ root.T, axes=(0, 1))  # (view_row, view_column, pupil_mode, n)
    wavefronts = np.tensordot(per_view, values, axes=(2, 0))  # (view_row, view_column, n, lenslet_row, lenslet_column)
    return np.asarray(np.linalg.norm(wavefronts, axis=2))
