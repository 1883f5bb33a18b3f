"""Measurement of a camera's nonlinearity from exposures of one still image.

All pixels of an exposure have been lit for the same time, and a pixel has the same light in each unit of time. So the
ratio of bright to dim pixels, over the exposures, separates the curve from exposures that begin late and from light
that drifts, which scale all pixels alike.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.frame.linearity import Linearity

_BINS = 20  # of pixels by brightness, with equally many
_DIM = 0.05  # of the brightest; dimmer pixels tell nothing
_FEWEST_PIXELS = 100
_DRIFTS = 2  # linear and quadratic in time
FEWEST_LEVELS = 4  # of the exposure time
LEAST_SPAN = 4.0  # longest over shortest exposure
_LEAST_FILL = 0.5  # highest signal over that of full scale
_MOST_DRIFT = 0.05  # of the light, over all exposures
_MOST_FLICKER = 0.01  # of the light, from exposure to exposure
_LEAST_FLICKER = 1e-5  # of the light; a smaller scatter is rounding
_MOST_MISFIT = 0.01  # of the signal, RMS over the exposures of the brightest pixels
_MOST_ERROR = 0.005  # standard error of the light over the signal at the highest signal


@dataclass(frozen=True, slots=True)
class MeasuredLinearity:
    """A nonlinearity with everything else that was found."""

    linearity: Linearity
    sigma: float  # standard error of the light over the signal at the highest signal
    late_s: float  # by which exposures are longer than the camera says
    late_sigma_s: float
    drift: float  # change of the light from the first to the last exposure, relative
    flicker: float  # scatter of the light from exposure to exposure, relative


class Exposures:
    """Signals of pixels of like brightness in exposures of one still image, in their order."""

    def __init__(self, brightest: Image, full_scale: float) -> None:
        """Choose the pixels by the signal of the longest exposure (row, column).

        It and `full_scale` are counts above the dark. Raises `ReconstructionError` if too few pixels are lit, or if
        that exposure does not reach half of full scale.
        """
        self._top = float(np.percentile(brightest, 99.9))
        if not self._top >= _LEAST_FILL * full_scale:
            raise ReconstructionError(
                f"the longest exposure reaches {max(self._top / full_scale, 0):.0%} of full scale: the nonlinearity"
                f" beyond would be unknown; at least {_LEAST_FILL:.0%} is needed"
            )
        lit = np.flatnonzero((brightest > _DIM * self._top) & (brightest < min(1.05 * self._top, full_scale)))
        if lit.size < _BINS * _FEWEST_PIXELS:
            raise ReconstructionError(f"only {lit.size} pixels have light: {_BINS * _FEWEST_PIXELS} are needed")
        order = lit[np.argsort(brightest.ravel()[lit], kind="stable")]
        self._bins = np.array_split(order, _BINS)
        self._exposure_s: list[float] = []
        self._moments: list[Floats] = []
        self._variance: list[Floats] = []

    def add(self, signal: Image, variance: Image, exposure_s: float) -> None:
        """Add an exposure: signal (row, column), counts above the dark, and its variance, counts^2."""
        share = signal.ravel().astype(np.float64) / self._top
        powers = [[np.mean(share[each] ** power) for each in self._bins] for power in (1, 2, 3)]
        errors = [np.mean(variance.ravel()[each], dtype=np.float64) / each.size for each in self._bins]
        self._exposure_s.append(exposure_s)
        self._moments.append(np.array(powers))
        self._variance.append(np.array(errors) / self._top**2)

    def fit(self, *, amplifier: str, em_gain: float) -> MeasuredLinearity:
        """Fit the curve; `ReconstructionError` says why the exposures do not tell it."""
        exposure_s = np.array(self._exposure_s)
        level_s, level = np.unique(np.round(exposure_s, 9), return_inverse=True)
        span = float(level_s[-1] / level_s[0]) if level_s.size else 0.0
        if len(level_s) < FEWEST_LEVELS or span < LEAST_SPAN:
            raise ReconstructionError(
                f"{len(level_s)} exposure times that span a factor of {span:.2g} do not tell a nonlinearity:"
                f" {FEWEST_LEVELS} that span {LEAST_SPAN:g} are needed"
            )
        fit = _Fit(np.array(self._moments), np.array(self._variance), exposure_s / level_s[-1], level)
        values, covariance, chi_square = fit.solve()
        a, b = values[:2]
        sigma = np.sqrt(np.diag(covariance))
        at_top = math.sqrt(float(covariance[:2, :2].sum()))
        if at_top > _MOST_ERROR:
            raise ReconstructionError(
                f"the nonlinearity is known to {at_top:.1%} only: average more frames, or let the light warm up"
            )
        return MeasuredLinearity(
            Linearity(
                quadratic=float(a),
                cubic=float(b),
                highest_counts=self._top,
                quadratic_sigma=float(sigma[0]),
                cubic_sigma=float(sigma[1]),
                chi_square=chi_square,
                amplifier=amplifier,
                em_gain=em_gain,
            ),
            sigma=at_top,
            late_s=float(values[2] * level_s[-1]),
            late_sigma_s=float(sigma[2] * level_s[-1]),
            drift=fit.drift,
            flicker=fit.flicker,
        )


class _Fit:
    """Least-squares fit of curve, beginning of the exposures, drift and light of each bin.

    Exposures of the same length tell flicker and drift, whatever the curve is.
    """

    def __init__(self, moments: Floats, variance: Floats, time: Floats, level: NDArray[np.intp]) -> None:
        self._moments, self._time = moments, time  # (exposure, power, bin), (exposure,)
        self._sigma = np.sqrt(np.maximum(variance, np.finfo(np.float64).eps))
        count = len(time)
        self._when = np.stack([np.linspace(-0.5, 0.5, count) ** (order + 1) for order in range(_DRIFTS)])
        self.flicker, changes = self._repeated(level)
        self.drift = float(changes[-1] - changes[0])
        if self.flicker > _MOST_FLICKER:
            raise ReconstructionError(
                f"the light flickers by {self.flicker:.1%} from exposure to exposure, at most {_MOST_FLICKER:.0%} is"
                " allowed: is it steady, the beam still?"
            )
        spread = float(np.ptp(changes))
        if spread > _MOST_DRIFT:
            raise ReconstructionError(
                f"the light drifted by {spread:.1%} during the exposures, at most {_MOST_DRIFT:.0%} can be separated:"
                " let it warm up"
            )

    def _repeated(self, level: NDArray[np.intp]) -> tuple[float, Floats]:
        """Flicker, and drift at each exposure, from exposures of equal length."""
        total = np.sum(self._moments[:, 0], axis=1)
        if not np.all(total > 0):
            raise ReconstructionError("an exposure shows no light above its dark: is the light on?")
        levels = np.eye(level.max() + 1)[level]
        terms = np.concatenate([levels, self._when.T], axis=1)
        freedom = len(level) - np.linalg.matrix_rank(terms)
        if freedom < 1:
            raise ReconstructionError("each exposure time is needed at least twice, in rising and falling order")
        found, *_ = np.linalg.lstsq(terms, np.log(total), rcond=None)
        scatter = np.linalg.norm(np.log(total) - terms @ found) / math.sqrt(freedom)
        return max(float(scatter), _LEAST_FLICKER), self._when.T @ found[levels.shape[1] :]

    def solve(self) -> tuple[Floats, Floats, float]:
        """Solve for curve, late beginning over the longest exposure, ...; covariance; chi-square."""
        count, bins = self._sigma.shape
        start = np.zeros(3 + _DRIFTS + bins + count)
        start[3 + _DRIFTS : 3 + _DRIFTS + bins] = np.max(self._moments[:, 0], axis=0)
        solution = scipy.optimize.least_squares(self._residuals, start, x_scale="jac")
        chi_square = 2 * float(solution.cost) / (solution.fun.size - start.size)
        misfit = float(np.sqrt(np.mean((solution.fun[: count * bins].reshape(count, bins) * self._sigma)[:, -1] ** 2)))
        if misfit > _MOST_MISFIT * float(np.mean(self._moments[:, 0, -1])):
            raise ReconstructionError(
                f"the signal of bright pixels differs by {misfit:.1%} of the highest one from any smooth curve: is the"
                " camera saturated, or did the image move?"
            )
        jacobian = np.asarray(solution.jac)
        covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(chi_square, 1.0)
        return solution.x, covariance, chi_square

    def _residuals(self, values: Floats) -> Floats:
        count, bins = self._sigma.shape
        a, b, late = values[:3]
        drift = values[3 : 3 + _DRIFTS] @ self._when
        brightness, flicker = values[3 + _DRIFTS : 3 + _DRIFTS + bins], values[-count:]
        light = self._moments[:, 0] + a * self._moments[:, 1] + b * self._moments[:, 2]
        expected = ((self._time + late) * np.exp(drift + flicker))[:, None] * brightness
        return np.concatenate([((light - expected) / self._sigma).ravel(), flicker / self.flicker])
