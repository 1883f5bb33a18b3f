"""Zonal solves: residuals of any displacements, and our solve timed beside Southwell's bare equations."""

import math
from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from app.evaluation.benchmark.stopwatch import medians_s, side_by_side
from app.evaluation.benchmark.timed_frames import TimedFrames
from reconstruction.arrays import Floats
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.settings import RegistrationSettings
from reconstruction.solve.zonal import zonal_wavefront
from reconstruction.wavefront import rms


def residual_rad(frames: TimedFrames, coefficients: Floats) -> float:
    """Mean over the views of the RMS of the zonal wavefront minus the truth, rad; NaN without a truth.

    `coefficients` of the field modes, px, (lenslet, xy, field_mode), NaN for lost lenslets, which do not count.
    """
    if frames.truth is None:
        return math.nan
    sensor = frames.sensor
    coefficients = coefficients.reshape(sensor.lenslet_rows, sensor.lenslet_columns, *coefficients.shape[1:])
    valid = np.asarray(np.isfinite(coefficients).all(axis=(2, 3)))
    slopes = _slopes(frames, np.swapaxes(coefficients, 2, 3))
    return float(np.nanmean(rms(zonal_wavefront(slopes, valid, pitch_m=sensor.lenslet_pitch_m) - frames.truth)))


def zonal_times(frames: TimedFrames, budget_s: float) -> dict[str, float]:
    """Time the zonal solve of all views beside bare equations of the same kind."""
    sensor = frames.sensor
    coefficients = frames.reconstructor(RegistrationSettings(warp="quadratic")).register(frames.frame).coefficients
    slopes = _slopes(frames, np.nan_to_num(coefficients))
    slopes = slopes.reshape(-1, *slopes.shape[2:])
    valid = np.ones(coefficients.shape[:2], np.bool_)
    bare = bare_southwell(sensor.lenslet_rows, sensor.lenslet_columns, sensor.lenslet_pitch_m)

    def ours() -> Floats:
        return zonal_wavefront(slopes, valid, pitch_m=sensor.lenslet_pitch_m)

    times_s = medians_s(side_by_side({"ours": ours, "bare": lambda: bare(slopes)}, budget_s))
    return {
        "ours_s": times_s["ours"],
        "scipy_splu_s": times_s["bare"],
        "ratio": times_s["bare"] / times_s["ours"],
        "largest_difference_rad": float(np.abs(ours() - bare(slopes)).max()),
    }


def _slopes(frames: TimedFrames, coefficients: Floats) -> Floats:
    """Slopes of all views, rad/m, (view_row, view_column, lenslet_row, lenslet_column, xy).

    `coefficients` (lenslet_row, lenslet_column, field_mode, xy), px.
    """
    x, y = (view_m / frames.field.half_width_m for view_m in (frames.field.view_x_m, frames.field.view_y_m))
    modes = LegendreModes(coefficients.shape[2]).values(x, y[:, None])
    return np.asarray(np.einsum("rcqd,qyx->yxrcd", coefficients, modes) * frames.sensor.slope_per_px)


def bare_southwell(rows: int, columns: int, pitch_m: float) -> Callable[[Floats], Floats]:
    """Factorise Southwell's equations by SciPy's `splu` for a lattice without lost lenslets.

    Returns a function from slopes (case, lenslet_row, lenslet_column, xy), rad/m, to wavefronts (case, lenslet_row,
    lenslet_column), rad, without piston.
    """

    def steps(count: int) -> tuple[sparse.csr_array, sparse.csr_array]:
        shape = (count - 1, count)
        return (
            sparse.csr_array(sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=shape)),
            sparse.csr_array(sparse.diags_array([0.5, 0.5], offsets=[0, 1], shape=shape)),
        )

    (along_x, mean_x), (along_y, mean_y) = steps(columns), steps(rows)
    one_row, one_column = sparse.eye_array(columns), sparse.eye_array(rows)
    difference = sparse.vstack([sparse.kron(one_column, along_x), sparse.kron(along_y, one_row)]).tocsc()[:, 1:]
    average = sparse.block_diag([sparse.kron(one_column, mean_x), sparse.kron(mean_y, one_row)])
    factors = splu((difference.T @ difference).tocsc())
    right = (difference.T @ average * pitch_m).tocsr()

    def solve(slopes: Floats) -> Floats:
        flat = np.moveaxis(slopes, -1, 1).reshape(len(slopes), -1)
        phase = factors.solve(right @ flat.T)
        phase = np.concatenate([np.zeros((1, len(slopes))), phase])
        return np.asarray((phase - phase.mean(axis=0)).T.reshape(len(slopes), rows, columns))

    return solve
