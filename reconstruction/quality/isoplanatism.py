"""Isoplanatism: difference of wavefronts against their separation in the field.

The isoplanatic patch ends where the RMS difference of two wavefronts reaches 1 rad (after Fried, J. Opt. Soc. Am. 72,
52, 1982), here as a separation in metres. Tip and tilt displace an image without blurring it; therefore all figures
are also given without them.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, centered_steps
from reconstruction.wavefront import Wavefront, rms, without_piston, without_zernikes

_LIMIT_RAD = 1.0  # RMS difference that ends the isoplanatic patch
_ACROSS = 7  # positions across the field
_TILT = 2, 3  # Noll's numbers


@dataclass(frozen=True, slots=True, eq=False)
class StructureCurve:
    """RMS difference of wavefronts without piston of all pairs of positions, by separation; NaN if none is known."""

    separation_m: Floats  # root mean square of the pairs in the bin, (separation,), rising
    rms_rad: Floats  # root mean square over the pairs in the bin, (separation,)
    least_rad: Floats  # of the pairs in the bin, (separation,)
    most_rad: Floats  # (separation,)

    @property
    def patch_m(self) -> float:
        """Separation of 1 rad RMS difference, linear from (0, 0); infinite beyond the field, NaN if unknown."""
        known = np.isfinite(self.rms_rad)
        if not known.any():
            return float("nan")
        separation_m, rms_rad = np.append(0.0, self.separation_m[known]), np.append(0.0, self.rms_rad[known])
        beyond = np.flatnonzero(rms_rad >= _LIMIT_RAD)
        if not beyond.size:
            return float("inf")
        pair = slice(beyond[0] - 1, beyond[0] + 1)
        return float(np.interp(_LIMIT_RAD, rms_rad[pair], separation_m[pair]))


@dataclass(frozen=True, slots=True, eq=False)
class Isoplanatism:
    """Error of one wavefront, the mean, for the whole field, and the patch over which it holds."""

    curve: StructureCurve
    curve_without_tilt: StructureCurve
    error_rad: float  # RMS over field and pupil of the difference from the mean wavefront
    error_without_tilt_rad: float
    view_error_rad: Floats  # at each view, (view_row, view_column); NaN outside the field


def isoplanatism(wavefront: Wavefront) -> Isoplanatism:
    """Compare the wavefronts at 7 x 7 positions over the field."""
    field = wavefront.field
    position_m = field_cell_middles_m(field, _ACROSS)
    x, y = position_m.T / field.half_width_m
    phase = wavefront.solution.wavefront(np.moveaxis(wavefront.displacement.modes.values(x, y), 0, -1))
    flat = without_zernikes(phase, _TILT, wavefront.sensor)
    step_m = 2 * field.half_width_m / _ACROSS
    mean = without_piston(np.mean(phase, axis=0))
    return Isoplanatism(
        curve=structure_curve(phase, position_m, bin_m=step_m),
        curve_without_tilt=structure_curve(flat, position_m, bin_m=step_m),
        error_rad=global_error_rad(phase),
        error_without_tilt_rad=global_error_rad(flat),
        view_error_rad=rms(wavefront.views - mean),
    )


def field_cell_middles_m(field: Field, across: int) -> Floats:
    """Middles of `across` x `across` equal parts of the field's square, inside it: (position, xy)."""
    steps = centered_steps(across) * 2 / across
    position = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return position[field.contains(*position.T)] * field.half_width_m


def structure_curve(phase: Floats, position_m: Floats, *, bin_m: float) -> StructureCurve:
    """Compare all pairs of wavefronts (position, lenslet_row, lenslet_column), rad, over lenslets known in both.

    `position_m` is (position, xy). Bins are `bin_m` wide, centred on multiples of it.
    """
    first, second = np.triu_indices(len(phase), 1)
    difference_rad = _differences(without_piston(phase).reshape(len(phase), -1))[first, second]
    separation_m = np.hypot(*(position_m[first] - position_m[second]).T)
    number = np.rint(separation_m / bin_m)
    bins = [number == one for one in np.unique(number)]
    known = [difference_rad[one & np.isfinite(difference_rad)] for one in bins]
    return StructureCurve(
        separation_m=np.array([_root_mean_square(separation_m[one]) for one in bins]),
        rms_rad=np.array([_root_mean_square(each) if each.size else np.nan for each in known]),
        least_rad=np.array([each.min() if each.size else np.nan for each in known]),
        most_rad=np.array([each.max() if each.size else np.nan for each in known]),
    )


def _differences(phase: Floats) -> Floats:
    """RMS difference about its mean of each two of some wavefronts (position, lenslet), rad; NaN if unknown.

    Products of matrices give the sums over the lenslets known in both, sixteen times as fast as all differences.
    """
    known = np.isfinite(phase)
    count = known.sum(axis=0)
    middle = np.where(known, phase, 0).sum(axis=0) / np.maximum(count, 1)  # subtracted, so that no digits are lost
    values, known = np.where(known, phase - middle, 0), known.astype(np.float64)
    lenslets, sums, squares = known @ known.T, values @ known.T, values**2 @ known.T
    with np.errstate(invalid="ignore"):
        mean = (sums - sums.T) / lenslets
        variance = (squares + squares.T - 2 * values @ values.T) / lenslets - mean**2
    return np.asarray(np.sqrt(np.maximum(variance, 0)))


def global_error_rad(phase: Floats) -> float:
    """RMS of wavefronts (position, lenslet_row, lenslet_column), rad, about their mean; NaN if none is known in all."""
    return _root_mean_square(rms(phase - np.mean(phase, axis=0)))


def _root_mean_square(values: Floats) -> float:
    """Root mean square of values of any shape, in their unit."""
    return float(np.sqrt(np.mean(values**2)))
