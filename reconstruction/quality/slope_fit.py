"""Measured wavefronts against those fitted by the pupil modes."""

from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.solve.modal import ModalSolution
from reconstruction.solve.zonal import zonal_wavefront
from reconstruction.wavefront import Wavefront, modes_at_views, without_piston


@dataclass(frozen=True, slots=True, eq=False)
class SlopeFit:
    """Views without piston, rad, (view_row, view_column, lenslet_row, lenslet_column); NaN if unknown."""

    measured: Floats  # from the slopes
    fitted: Floats  # by the pupil modes
    difference: Floats  # measured minus fitted: noise, and what the modes cannot represent


def slope_fit(wavefront: Wavefront, sensor: Sensor, modes: PupilModes) -> SlopeFit:
    """Compare the views of a wavefront with the slopes measured; `modes` are those of the reconstruction.

    Modal: the difference is the integral of the misfit of the displacements, the measured wavefront is the fit plus it.
    (Integrating the slopes themselves would add Southwell's discretisation error, many times the difference.) Zonal:
    the views are the measured wavefront; the fit is the least-squares fit of the modes to them.
    """
    solution, views = wavefront.solution, wavefront.views
    if not isinstance(solution, ModalSolution):
        fitted = _fit(views, modes)
        return SlopeFit(views, fitted, without_piston(views - fitted))
    displacement = wavefront.displacement
    field_modes, is_inside = modes_at_views(wavefront.field, displacement.modes)
    misfit = np.tensordot(field_modes, solution.misfit, axes=([-1], [2])) * sensor.slope_per_px
    known, pitch_m = displacement.valid & modes.inside, sensor.lenslet_pitch_m
    difference = zonal_wavefront(misfit, known, pitch_m=pitch_m, arrangement=sensor.arrangement)
    difference[~is_inside] = np.nan
    return SlopeFit(without_piston(views + difference), views, difference)


def _fit(views: Floats, modes: PupilModes) -> Floats:
    """Least-squares fit of the modes to each view; equal known lenslets share a decomposition."""
    flat = views.reshape(-1, *views.shape[2:])
    known = np.isfinite(flat) & modes.inside
    fitted = np.full_like(flat, np.nan)
    for is_known in np.unique(known, axis=0):
        alike = np.flatnonzero((known == is_known).all(axis=(1, 2)))
        values = modes.values[:, is_known].T
        row, column = np.nonzero(is_known)
        fitted[alike[:, None], row, column] = (values @ np.linalg.lstsq(values, flat[alike][:, is_known].T)[0]).T
    return without_piston(fitted.reshape(views.shape))
