"""How freely a warp may bend when the settings leave it open: as freely as the camera's noise allows.

The quadratic modes remove most of what the estimator gets wrong systematically, and add noise. Which is more follows
from the reference and the camera alone. The cubic ones are never chosen here: they pay when a wavefront is
refined and no light strays into the neighbours' cells, which is for the user to know; where it does, they are worse.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from reconstruction.displacement import Displacement
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.settings import Warp
from reconstruction.solve.modal import ModalSolver
from reconstruction.solve.whitening import whitening
from reconstruction.wavefront import Wavefront

_PUPIL_MODES = 45  # with which noise is predicted: about as many as a smooth wavefront needs
# By how much the residual shrinks from affine to quadratic on the screens of docs/estimator.md (4.2 rad RMS), as the
# root of the difference of squares.
_QUADRATIC_GAIN_RAD = 0.15


def automatic_warp(own: Callable[[Warp], Displacement], sensor: Sensor, field: Field) -> Warp:
    """The warp of choice; own(warp) is what a warp makes of the reference itself."""
    added_rad2 = _noise_rad2(own("quadratic"), sensor, field) - _noise_rad2(own("affine"), sensor, field)
    return "quadratic" if added_rad2 < _QUADRATIC_GAIN_RAD**2 else "affine"


def _noise_rad2(displacement: Displacement, sensor: Sensor, field: Field) -> float:
    """Mean variance of the views' wavefronts, rad^2, if every lenslet were as certain as those that are lit."""
    valid = displacement.valid
    if not valid.any():
        return np.inf
    everywhere = np.ones(valid.shape, np.bool_)  # few lenslets lit would not carry the modes
    mean = np.mean(displacement.covariance[valid], axis=0) * sensor.slope_per_px**2
    covariance = np.broadcast_to(mean, displacement.covariance.shape)
    lattice_count = pupil_modes(sensor, "legendre", None).values.shape[0]
    modes = pupil_modes(sensor, "legendre", min(_PUPIL_MODES, lattice_count))
    solver = ModalSolver(modes, whitening(displacement.covariance), is_smooth=False)
    slopes = np.zeros_like(displacement.coefficients)
    wavefront = Wavefront.of(sensor, field, displacement, solver(slopes, covariance, everywhere))
    return float(np.nanmean(wavefront.sigma() ** 2))
