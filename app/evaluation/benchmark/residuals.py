"""How wrong the wavefronts are that follow from displacements: by the same zonal solve for all."""

from __future__ import annotations

import math

import numpy as np

from app.evaluation.benchmark.cases import Case
from reconstruction.arrays import Floats
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.solve.zonal import zonal_wavefront
from reconstruction.wavefront import rms


def residual_rad(case: Case, coefficients: Floats) -> float:
    """Mean over the views of the RMS of found minus true wavefront, rad; NaN where no truth is known.

    coefficients c_q of the field modes, px, (lenslet, xy, field_mode), NaN where lost: those lenslets do not count.
    """
    if case.truth is None:
        return math.nan
    sensor, field = case.sensor, case.field
    coefficients = coefficients.reshape(sensor.lenslet_rows, sensor.lenslet_columns, *coefficients.shape[1:])
    x, y = field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m
    modes = LegendreModes(coefficients.shape[-1]).values(x, y[:, None])
    slopes = np.einsum("rcdq,qyx->yxrcd", coefficients, modes) * sensor.slope_per_px
    valid = np.asarray(np.isfinite(coefficients).all(axis=(2, 3)))
    views = zonal_wavefront(slopes, valid, pitch_m=sensor.lenslet_pitch_m)
    return float(np.nanmean(rms(views - case.truth)))
