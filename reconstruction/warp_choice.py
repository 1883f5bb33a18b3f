"""Expected error of each warp: predicted noise and measured systematic error."""

from dataclasses import replace

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement, Outcome
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.layered_modes import layered_wavefronts
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.settings import Warp
from reconstruction.solve.modal import ModalSolver
from reconstruction.solve.sensitivity import MeanGradients
from reconstruction.wavefront import Wavefront

_PUPIL_MODES = 45  # for the predicted noise; a smooth wavefront needs about as many
# Systematic error, rad: mean over the ensembles of docs/estimator.md with the square, in the paper's world (4.2 rad).
_SYSTEMATIC_RAD: dict[Warp, float] = {"affine": 0.24, "quadratic": 0.036, "cubic": 0.009, "quartic": 0.007}
CHOSEN_WARPS = list(_SYSTEMATIC_RAD)


def expected_error_rad2(
    warp: Warp, parameters: Floats, at_rest: Displacement, *, sensor: Sensor, field: Field
) -> float:
    """Mean expected square error of the views, rad^2, if every lenslet were as certain as the mean valid one.

    Parameters
    ----------
    warp
        Its systematic error is added to the noise.
    parameters : (K, 2Q)
        Displacement (x modes, y modes) of each parameter of the warp.
    at_rest : Displacement
        Of the reference against itself, with its covariance.
    """
    valid = at_rest.valid
    if not valid.any():
        return np.inf
    everywhere = replace(
        at_rest,
        coefficients=np.zeros_like(at_rest.coefficients),
        # A few lit lenslets could not carry the modes.
        covariance=np.broadcast_to(np.mean(at_rest.covariance[valid], axis=0), at_rest.covariance.shape),
        outcome=np.full_like(at_rest.outcome, Outcome.CONVERGED),
    )
    lattice_count = len(pupil_modes(sensor, "legendre", None).degree)
    modes = pupil_modes(sensor, "legendre", min(_PUPIL_MODES, lattice_count))
    solver = ModalSolver(
        modes,
        MeanGradients(sensor, parameters),
        parameters,
        everywhere.covariance,
        layered=layered_wavefronts(sensor, modes, at_rest.modes, parameters),
    )
    noise = np.nanmean(Wavefront.of(sensor, field, everywhere, solver(everywhere)).sigma() ** 2)
    return float(noise) + _SYSTEMATIC_RAD[warp] ** 2
