"""Displacements caused by the modes of a wavefront: the design matrix of the modal reconstruction.

A lenslet's displacement is written in K parameters, the rows of `parameters` (K, x modes and then y modes).
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.lenslet_wavefronts import local_wavefronts
from reconstruction.modes.pupil_modes import PupilModes

Lenslets: TypeAlias = slice | NDArray[np.intp]
Sensitivity: TypeAlias = Callable[[PupilModes, Lenslets], Floats]
"""Parameters, px, of some lenslets per rad of each mode but the piston: (lenslet, K, pupil_mode - 1, field_mode)."""


def geometric_sensitivity(sensor: Sensor, parameters: Floats) -> Sensitivity:
    """Mean gradients of the pupil modes over each lenslet, the same for all field modes."""
    along = parameters.reshape(len(parameters), 2, -1) / sensor.slope_per_px  # (K, xy, field_mode)

    def sensitivity(modes: PupilModes, lenslets: Lenslets) -> Floats:
        gradients = modes.gradients[1:].reshape(len(modes.gradients) - 1, -1, 2)[:, lenslets]
        return np.asarray(np.einsum("plx,kxq->lkpq", gradients, along, optimize=True))

    return sensitivity


def response_sensitivity(sensor: Sensor, response: Floats) -> Sensitivity:
    """Response to local wavefronts, (lenslet, n, m, field_mode, K), px per rad: see `registration.response`."""
    degree = response.shape[1] - 1
    n, m = np.nonzero(np.any(response, axis=(0, 3, 4)))

    def sensitivity(modes: PupilModes, lenslets: Lenslets) -> Floats:
        local = local_wavefronts(modes.products[1:], sensor, degree)
        local = local.reshape(-1, *local.shape[2:])[lenslets][:, n, m]  # (lenslet, j, pupil_mode - 1)
        return np.asarray(np.einsum("ljp,ljqk->lkpq", local, response[lenslets][:, n, m], optimize=True))

    return sensitivity
