"""How well the reconstructed wavefronts say what was measured: measured, fitted and difference, view by view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.solve.modal import ModalSolution
from reconstruction.solve.zonal import zonal_wavefront
from reconstruction.wavefront import Wavefront, without_piston


@dataclass(frozen=True, slots=True, eq=False)
class SlopeFit:
    """Wavefronts without piston, rad, each (view_row, view_column, lenslet_row, lenslet_column); NaN where unknown."""

    measured: Floats  # what the slopes of the view's lenslets say
    fitted: Floats  # the pupil modes that say it as well as they can
    difference: Floats  # measured minus fitted: noise, and what the pupil modes are too few for


def slope_fit(wavefront: Wavefront, sensor: Sensor, modes: PupilModes) -> SlopeFit:
    """Compare a wavefront's views with what their lenslets measured; `modes` are those that it was fitted with.

    The modal method has fitted its modes to the slopes. What the fit leaves of the slopes is integrated from lenslet to
    lenslet; that is the difference, and the measured wavefront is the fit plus it. (To integrate the slopes themselves
    would add the rounding of Southwell's equations where they bend between two lenslets, many times the difference.)

    The zonal method fits nothing: its views are what was measured, and the fit is that of the modes to them by least
    squares, inside the modes' pupil.
    """
    solution, views = wavefront.solution, wavefront.views
    if not isinstance(solution, ModalSolution):
        fitted = _fit(views, modes)
        return SlopeFit(views, fitted, without_piston(views - fitted))
    field, displacement = wavefront.field, wavefront.displacement
    x, y = field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m
    field_modes = np.moveaxis(displacement.modes.values(x, y[:, None]), 0, -1)
    measured = np.tensordot(field_modes, displacement.coefficients, axes=([-1], [2])) * sensor.slope_per_px
    fitted = np.tensordot(field_modes @ solution.coefficients.T, modes.gradients, axes=1)
    difference = zonal_wavefront(measured - fitted, displacement.valid & modes.inside, pitch_m=sensor.lenslet_pitch_m)
    difference[~field.contains(x, y[:, None])] = np.nan
    return SlopeFit(without_piston(views + difference), views, difference)


def _fit(views: Floats, modes: PupilModes) -> Floats:
    """Least-squares fit of the modes to each view, at the lenslet centres that are known and inside the pupil.

    Views that know the same lenslets, all of them as a rule, share one decomposition.
    """
    flat = views.reshape(-1, *views.shape[2:])
    known = np.isfinite(flat) & modes.inside
    fitted = np.full_like(flat, np.nan)
    for mask in np.unique(known, axis=0):
        alike = np.flatnonzero((known == mask).all(axis=(1, 2)))
        values = modes.values[:, mask].T
        row, column = np.nonzero(mask)
        fitted[alike[:, None], row, column] = (values @ np.linalg.lstsq(values, flat[alike][:, mask].T)[0]).T
    return without_piston(fitted.reshape(views.shape))
