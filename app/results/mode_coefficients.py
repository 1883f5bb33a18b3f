"""Coefficients of one wavefront in Zernike or Legendre modes, with names, error bars and their map over the field."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor, centered_steps
from reconstruction.modes.pupil_modes import BASES, pupil_modes
from reconstruction.settings import PupilBasis
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront

_MOST_MODES = 36  # all up to degree 7
_MAP_ACROSS = 21  # positions across the field


@dataclass(frozen=True, slots=True)
class ModeChoice:
    """Selection of the coefficients to compute."""

    basis: PupilBasis
    field_mode: int | None  # e_pq of this field mode q; None: the modes of the selected view
    view: tuple[int, int]  # the selected view
    mapped: int | None = None  # mode whose coefficient is mapped over the field


@dataclass(frozen=True, slots=True, eq=False)
class ModeCoefficients:
    """Coefficients of the modes but the piston, which is always first."""

    choice: ModeChoice
    names: tuple[str, ...]  # (pupil_mode,)
    rad: Floats  # (pupil_mode,); NaN if nothing is known of the wavefront
    sigma_rad: Floats  # standard deviation for a single frame, (pupil_mode,); NaN where unknown
    field_map: Floats | None  # of the mapped mode, rad, (row, column); NaN outside the field


def mode_coefficients(wavefront: Wavefront, choice: ModeChoice) -> ModeCoefficients:
    """Fit modes to the wavefront at the lenslet centres: to the selected view as shown, or to that of a field mode.

    Legendre modes are fitted over all known lenslets, Zernike modes over those in the circle. With the modes of the
    reconstruction, the fit returns its coefficients.
    """
    sensor, displacement, solution = wavefront.sensor, wavefront.displacement, wavefront.solution
    weights = np.zeros(displacement.modes.count)
    if choice.field_mode is None:
        row, column = choice.view
        field = wavefront.field
        x, y = field.view_x_m[column] / field.half_width_m, field.view_y_m[row] / field.half_width_m
        weights, phase = displacement.modes.values(x, y), wavefront.views[choice.view]
    else:
        weights[choice.field_mode] = 1.0
        phase = solution.wavefront(weights)
    fit = _fit(sensor, choice.basis, np.isfinite(phase).tobytes())
    names = BASES[choice.basis].names(len(fit))
    sigma_rad = np.full(len(fit), np.nan)
    if isinstance(solution, ModalSolution):
        sigma_rad = np.linalg.norm(
            _apply(fit, np.moveaxis(solution.deviations(weights).astype(np.float64), -1, 0)), axis=0
        )
    field_map = None
    if choice.mapped is not None:
        by_mode = _apply(fit, solution.wavefront(np.eye(displacement.modes.count)))[:, choice.mapped]
        field_map = _over_field(wavefront, by_mode)
    return ModeCoefficients(choice, names, _apply(fit, phase[None])[0], sigma_rad, field_map)


@lru_cache(maxsize=8)
def _fit(sensor: Sensor, basis: PupilBasis, known_bytes: bytes) -> Floats:
    """Matrix (pupil_mode, lenslet) from a wavefront to its least-squares coefficients; zero for unused lenslets."""
    most = min(sensor.lenslet_rows, sensor.lenslet_columns)
    modes = pupil_modes(sensor, basis, min(_MOST_MODES, most * (most + 1) // 2))
    known = np.frombuffer(known_bytes, np.bool_)
    used = known & modes.inside.ravel()
    fit = np.zeros((len(modes.values), used.size))
    if used.any():
        fit[:, used] = np.linalg.pinv(modes.values.reshape(len(fit), -1)[:, used].T)
    else:
        fit[:] = np.nan
    return fit


def _apply(fit: Floats, phases: Floats) -> Floats:
    """Coefficients (case, pupil_mode) of wavefronts (case, lenslet_row, lenslet_column)."""
    return np.asarray(np.nan_to_num(phases.reshape(len(phases), -1)) @ fit.T)


def _over_field(wavefront: Wavefront, by_mode: Floats) -> Floats:
    """Map over the field, (row, column), of what has the coefficients (field_mode,); NaN outside."""
    steps = centered_steps(_MAP_ACROSS) * 2 / (_MAP_ACROSS - 1)
    values = np.tensordot(by_mode, wavefront.displacement.modes.values(steps, steps[:, None]), axes=1)
    values[~wavefront.field.contains(steps, steps[:, None])] = np.nan
    return np.asarray(values)
