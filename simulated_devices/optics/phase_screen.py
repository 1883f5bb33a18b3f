"""Phase screen: phases on a grid about the optical axis, with a bicubic spline between them.

Arrays are [row, column], row = y; positions are in metres in the screen's own plane; phases in radians.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np
import scipy  # which loads its parts when they are used
import tifffile
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse

from reconstruction.arrays import Floats, reading_npy
from reconstruction.geometry import centered_steps, require

_CUBIC = 3
_T = TypeVar("_T", bound=np.generic)


class PhaseScreen:
    """Phases with an interpolating spline; a position outside the screen raises `ValueError`.

    `samples_rad` is (row, column), rad, centred on the axis; `sample_spacing_m` is the same along x and y.
    """

    def __init__(self, samples_rad: Floats, sample_spacing_m: float) -> None:
        samples_rad = np.array(samples_rad, np.float64)
        require(
            {
                "a phase screen must be a 2-D array of at least 4 x 4": (
                    samples_rad.ndim == 2 and min(samples_rad.shape) > _CUBIC
                ),
                "a phase screen must hold finite numbers only": bool(np.isfinite(samples_rad).all()),
            }
        )
        samples_rad.setflags(write=False)
        self.samples_rad = samples_rad
        self.sample_spacing_m = sample_spacing_m
        y_m, x_m = (centered_steps(count) * sample_spacing_m for count in samples_rad.shape)
        self.half_width_m = float(x_m[-1]), float(y_m[-1])  # (x, y)
        self._spline = scipy.interpolate.RectBivariateSpline(y_m, x_m, samples_rad)
        self._knots = self._spline.get_knots()  # along y, along x
        shape = tuple(len(knots) - _CUBIC - 1 for knots in self._knots)
        self.coefficients: Floats = np.reshape(self._spline.get_coeffs(), shape)

    def at(self, x_m: ArrayLike, y_m: ArrayLike) -> Floats:
        """Phase (rad) at positions in m, element by element; x and y broadcast against each other."""
        x_m, y_m = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        self._check(x_m, 1)
        self._check(y_m, 0)
        return np.asarray(self._spline.ev(y_m, x_m), np.float64)

    def basis(self, position_m: Floats, axis: int) -> sparse.csr_array[np.float32]:
        """Spline basis along y (axis 0) or x (1) at positions in m: sparse (position, coefficient)."""
        self._check(position_m, axis)
        return scipy.interpolate.BSpline.design_matrix(position_m, self._knots[axis], _CUBIC).astype(np.float32)

    def scaled(self, factor: float) -> PhaseScreen:
        """Return the screen with every phase multiplied by `factor`."""
        return PhaseScreen(self.samples_rad * factor, self.sample_spacing_m)

    def _check(self, position_m: Floats, axis: int) -> None:
        name, half_width_m = "yx"[axis], self.half_width_m[1 - axis]
        reach_m = float(np.abs(position_m).max(initial=0.0))
        if not reach_m <= half_width_m:
            raise ValueError(
                f"a ray meets the screen's plane at {name} = {reach_m * 1e3:.4g} mm, but the screen ends at "
                f"{half_width_m * 1e3:.4g} mm; give it more samples or less drift"
            )


def smooth_screen(
    generator: np.random.Generator,
    *,
    samples: int,
    sample_spacing_m: float,
    correlation_length_m: float,
    enlarged_by: int = 0,
    guard: int = 0,
) -> Floats:
    """White noise smoothed by a Gaussian: (samples, samples), mean 0.

    `correlation_length_m` is its standard deviation. Margins of four standard deviations are computed and cut off, so
    that the edge is like the middle. With the generator `numpy.random.default_rng(seed)` this reproduces the project's
    ensemble to the last bit.

    `enlarged_by` adds that many samples on each side and keeps the middle: its noise is drawn first, and its mean is
    subtracted. If its `edge_is_final` is false, the middle's outermost ring can differ by the Gaussian's last tap, at
    most 2.5e-4 of the RMS in trials. `guard` adds further samples around all that in the same way.
    """
    sigma, margin = correlation_length_m / sample_spacing_m, _margin(correlation_length_m, sample_spacing_m)
    noise = generator.standard_normal((samples + 2 * margin, samples + 2 * margin))
    for ring in filter(None, (enlarged_by, guard)):
        middle, side = noise, len(noise) + 2 * ring
        noise = generator.standard_normal((side, side))
        noise[ring:-ring, ring:-ring] = middle
    end = len(noise) - margin
    # The two passes of gaussian_filter, the second only for the rows that are retained.
    smooth = ndimage.gaussian_filter1d(noise, sigma, axis=0)[margin:end]
    smooth = ndimage.gaussian_filter1d(smooth, sigma, axis=1)[:, margin:end]
    return np.asarray(smooth - middle_of(smooth, enlarged_by + guard).mean(), np.float64)


def edge_is_final(correlation_length_m: float, sample_spacing_m: float) -> bool:
    """True if enlarging a smooth screen changes none of it: its margin is as wide as the Gaussian."""
    return _margin(correlation_length_m, sample_spacing_m) == int(4 * (correlation_length_m / sample_spacing_m) + 0.5)


def _margin(correlation_length_m: float, sample_spacing_m: float) -> int:
    return int(4 * correlation_length_m / sample_spacing_m)  # the ensemble divides last, which can round differently


def middle_of(samples: NDArray[_T], rim: int) -> NDArray[_T]:
    """Cut `rim` samples off each side of an array (row, column)."""
    return samples[rim : len(samples) - rim, rim : samples.shape[1] - rim]


def shape_to_pv_and_rms(samples_rad: Floats, *, pv_rad: float, rms_rad: float, enlarged_by: int = 0) -> Floats:
    """Give a screen (row, column), rad, a peak-to-valley and an RMS by a smooth monotone map.

    With z the screen in units of its RMS, z -> sinh(b z)/b stretches the extremes (b > 0) and z -> asinh(b z)/b
    compresses them; b sets the ratio PV/RMS, and the result is scaled. Contours keep their places. If the screen is
    `enlarged_by` samples on each side, its middle has that PV and RMS.
    """
    middle = middle_of(samples_rad, enlarged_by)
    z = (samples_rad - middle.mean()) / middle.std()

    def mapped(bend: float, z: Floats) -> Floats:
        if abs(bend) < 1e-9:
            return np.asarray(z, np.float64)
        return np.asarray(np.sinh(bend * z) if bend > 0 else np.arcsinh(-bend * z), np.float64)

    def excess(bend: float) -> float:
        shaped = mapped(bend, middle_of(z, enlarged_by))
        return float(np.ptp(shaped) / shaped.std()) - pv_rad / rms_rad

    try:
        bend = float(scipy.optimize.brentq(excess, -1e3, 20.0, xtol=1e-13))
    except ValueError:
        raise ValueError(f"pv_rad = {pv_rad:g} with rms_rad = {rms_rad:g} cannot be reached by this screen") from None
    shaped = mapped(bend, z)
    middle = middle_of(shaped, enlarged_by)
    return np.asarray((shaped - middle.mean()) * (rms_rad / middle.std()), np.float64)


def read_screen(path: Path, setting: str = "file", content: str = "phases in rad") -> Floats:
    """Values (row, column) of a .npy or .tif file; `ValueError`, with the setting, if it is bad."""
    try:
        with reading_npy():
            values = np.asarray(np.load(path, allow_pickle=False) if path.suffix == ".npy" else tifffile.imread(path))
    except Exception as error:  # damaged files make tifffile raise anything
        raise ValueError(f"{setting} = {str(path)!r} is not a readable .npy or .tif array: {error}") from error
    if values.ndim != 2 or not values.size or values.dtype.kind not in "buif" or not np.isfinite(values).all():
        raise ValueError(f"{setting} = {str(path)!r} must hold a 2-D array of finite {content}")
    return values.astype(np.float64)
