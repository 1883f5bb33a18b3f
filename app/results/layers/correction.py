"""Correctors at every distance as a dataset with names and units (docs/layers.md)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from app.bench.config import Bench
from app.results.layers.dataset import MAP_POINTS, Origin, distance_in_words, distance_m, from_where, possible_origin
from app.results.view_quality import about
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.layers.corrector import Correction, Corrector, best_correction, field_positions_m
from reconstruction.wavefront import rms

_SHARES = np.linspace(-0.95, 0.95, 77)  # ratio / (1 + |ratio|) of the correctors compared
_REFINED = 0.02  # about the best of them


@dataclass(frozen=True, slots=True, eq=False)
class CorrectorComparison:
    """Correctors at every distance, the chosen one, and the wavefronts that they correct."""

    curve: tuple[Correction, ...]  # over the distance, the chosen one among them
    chosen: Correction
    positions_m: Floats  # in the field, (position, xy)
    uncorrected_rad: float  # RMS over field and pupil


def compare_correctors(
    phase_at: Callable[[float, float], Floats],
    sensor: Sensor,
    field: Field,
    corrector: Corrector,
    ratio: float | None = None,
) -> CorrectorComparison:
    """Find the best command of correctors at every distance, and choose the best of them, or the one at `ratio`.

    `phase_at` returns the wavefront at a field position (x_m, y_m), rad, (lenslet_row, lenslet_column); `ValueError` if
    no lenslet is known.
    """
    positions_m = field_positions_m(field)
    wavefronts = np.array([phase_at(x_m, y_m) for x_m, y_m in positions_m])
    if np.array_equal(wavefronts, np.broadcast_to(wavefronts[0], wavefronts.shape), equal_nan=True):
        raise ValueError("the wavefront is the same at every field position: correctors at all distances are alike")

    def at(share: float) -> Correction:
        return best_correction(wavefronts, positions_m, sensor, field, float(share / (1 - abs(share))), corrector)

    curve = [at(share) for share in _SHARES]
    if ratio is None:
        best = _SHARES[int(np.argmin([made.mean_residual_rad for made in curve]))]
        curve += [at(share) for share in best + np.linspace(-_REFINED, _REFINED, 21) if abs(share) < _SHARES[-1]]
        chosen = min(curve, key=lambda made: made.mean_residual_rad)
    else:
        chosen = best_correction(wavefronts, positions_m, sensor, field, ratio, corrector)
        curve.append(chosen)
    different = {made.ratio: made for made in sorted(curve, key=lambda made: made.ratio)}
    uncorrected_rad = float(np.sqrt(np.nanmean(rms(wavefronts) ** 2)))
    return CorrectorComparison(tuple(different.values()), chosen, positions_m, uncorrected_rad)


def correction_dataset(found: CorrectorComparison, bench: Bench, origin: Origin = "lenslets") -> xr.Dataset:
    """Return residual and Strehl ratio over the distance, and those of the chosen corrector over the field.

    Distances are from the lenslets if the corrector lies behind them, see `possible_origin`.
    """
    curve, made = found.curve, found.chosen
    origin = possible_origin(origin, [made.ratio])
    distances_m = distance_m(np.array([each.ratio for each in curve]), origin, bench)
    order = np.argsort(distances_m)[: np.count_nonzero(np.isfinite(distances_m))]  # NaN comes last
    residual, strehl = (
        np.array(values)[order]
        for values in ([each.mean_residual_rad for each in curve], [np.nanmean(each.strehl) for each in curve])
    )
    of_distance = f"of the corrector; {from_where(origin)}"
    x_m, y_m, phase = made.phase_map(MAP_POINTS)
    return xr.Dataset(
        {
            "uncorrected": ((), found.uncorrected_rad, about("rad", "RMS over field and pupil without a corrector")),
            "residual": ("distance", residual, about("rad", "RMS over field and pupil after the best command")),
            "strehl": ("distance", strehl, about("1", "mean over the field")),
            "corrector_distance_m": ((), distance_m(made.ratio, origin, bench), about("m", of_distance)),
            "corrector_residual": ((), made.mean_residual_rad, about("rad", "RMS over field and pupil")),
            "field_residual": ("position", made.residual_rad, about("rad", "RMS at a field position")),
            "field_strehl": ("position", made.strehl, about("1", "at a field position")),
            "command": ("shape", made.command, about("rad", "best command: the corrector adds these shapes")),
            "command_phase": (("y", "x"), phase, about("rad", "phase that the corrector adds, without piston")),
        },
        coords={
            "distance": ("distance", distances_m[order], about("m", of_distance)),
            "field_x": ("position", found.positions_m[:, 0], about("m", "field position")),
            "field_y": ("position", found.positions_m[:, 1], about("m", "field position")),
            "x": ("x", x_m, about("m", "on the plane s = u + r x")),
            "y": ("y", y_m, about("m", "on the plane s = u + r x")),
        },
        attrs={
            "title": "Best commands of a corrector",
            "distances_from": origin,
            "influence": made.corrector.influence,
            "shapes": made.corrector.count,
        },
    )


def in_words(found: xr.Dataset) -> str:
    """Residuals of correctors at the pupil and at the chosen distance, and without one."""
    origin, residual = found.attrs["distances_from"], found["residual"].values
    at_pupil = residual[np.argmin(np.abs(found["distance"].values)) if origin == "lenslets" else -1]
    place = distance_in_words(float(found["corrector_distance_m"]), np.nan, origin)
    return (
        f"one corrector at the pupil leaves {at_pupil:.2g} of {float(found['uncorrected']):.2g} rad RMS;"
        f" {place}, {float(found['corrector_residual']):.2g} rad (Strehl {float(found['field_strehl'].mean()):.2f})"
    )
