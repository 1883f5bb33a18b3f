"""How well the reconstructed wavefronts say what was measured: measured, fitted and difference, view by view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruction.geometry import Floats, Sensor
from reconstruction.pupil_modes import PupilModes
from reconstruction.wavefront import Wavefront, without_piston
from reconstruction.zonal import ZonalSolution, zonal_wavefront


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Wavefronts without piston, rad, each (view_row, view_column, lenslet_row, lenslet_column); NaN where unknown."""

    measured: Floats  # the slopes at the view, integrated lenslet by lenslet
    fitted: Floats  # the pupil modes that say the same as smoothly as they can

    @property
    def difference(self) -> Floats:
        """Measured minus fitted, rad, piston removed: noise, and what the pupil modes are too few for."""
        return without_piston(self.measured - self.fitted)


def compare(wavefront: Wavefront, sensor: Sensor, modes: PupilModes) -> Comparison:
    """Compare a wavefront's views with what their lenslets measured, integrated as the zonal method does.

    The modal method has fitted its pupil modes to the slopes, and its views are the fit. The zonal method fits nothing:
    its views are what was measured, and the fit is that of `modes` to them by least squares, inside the modes' pupil.
    """
    if isinstance(wavefront.solution, ZonalSolution):
        return Comparison(wavefront.views, _fit(wavefront.views, modes))
    field, displacement = wavefront.field, wavefront.displacement
    x, y = field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m
    field_modes = np.moveaxis(displacement.modes.values(x, y[:, None]), 0, -1)
    slopes = np.tensordot(field_modes, displacement.coefficients, axes=([-1], [2])) * sensor.slope_per_px
    measured = zonal_wavefront(slopes, displacement.valid, pitch_m=sensor.lenslet_pitch_m)
    measured[~field.contains(x, y[:, None])] = np.nan
    return Comparison(measured, wavefront.views)


def _fit(views: Floats, modes: PupilModes) -> Floats:
    """Least-squares fit of the modes to each view, at the lenslet centres that are known and inside the pupil."""
    fitted = np.full_like(views, np.nan)
    for at in np.ndindex(views.shape[:2]):
        known = np.isfinite(views[at]) & modes.inside
        values = modes.values[:, known].T
        fitted[at][known] = values @ np.linalg.lstsq(values, views[at][known])[0]
    return without_piston(fitted)
