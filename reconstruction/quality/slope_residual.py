"""Residual of the slopes: measured wavefronts minus those fitted by the pupil modes."""

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.solve.modal import ModalSolution
from reconstruction.solve.zonal import zonal_wavefront
from reconstruction.wavefront import Wavefront, modes_at_views, without_piston


def slope_residual(wavefront: Wavefront, modes: PupilModes) -> Floats:
    """Return measured minus fitted views, rad, without piston; `modes` are those of the reconstruction.

    It holds noise, and what the modes cannot represent. Modal: the integral of the misfit of the displacements.
    (Integrating the slopes themselves would add Southwell's discretisation error, many times the residual.) Zonal:
    the views minus the least-squares fit of the modes to them.

    Returns
    -------
    Floats
        (view_row, view_column, lenslet_row, lenslet_column); NaN if unknown.
    """
    solution, views, sensor = wavefront.solution, wavefront.views, wavefront.sensor
    if not isinstance(solution, ModalSolution):
        return without_piston(views - _fit(views, modes))
    displacement = wavefront.displacement
    field_modes, is_inside = modes_at_views(wavefront.field, displacement.modes)
    misfit = np.tensordot(field_modes, solution.misfit, axes=([-1], [2])) * sensor.slope_per_px
    known, pitch_m = displacement.valid & modes.inside, sensor.lenslet_pitch_m
    residual = zonal_wavefront(misfit, known, pitch_m=pitch_m, arrangement=sensor.arrangement)
    residual[~is_inside] = np.nan
    return residual


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
