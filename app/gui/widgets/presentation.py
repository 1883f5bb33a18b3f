"""Presentation of each quantity: its colour scale, captions and number formats."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from app.gui.widgets.scales import ColourScale, bright, diverging, uncertain
from app.results.view_analysis import Quantity
from reconstruction.arrays import Floats
from reconstruction.wavefront import peak_to_valley, rms

NOTHING = "\N{EN DASH}"
_MOST_DECIMALS = 6


def _phase_captions(phases: Floats) -> list[tuple[str, ...]]:
    both = zip(rms(phases).tolist(), peak_to_valley(phases).tolist(), strict=True)
    return [_wordings("RMS", number(one), f"PV {number(other)}") for one, other in both]


def _phase_summary(maps: Floats, unit: str) -> str:
    return f"mean RMS {number(_mean(rms(maps)))} {unit}"


@dataclass(frozen=True, slots=True)
class Presentation:
    """Display format of one quantity; the defaults are those of a phase."""

    about: str  # tool tip
    scale: Callable[[float, str], ColourScale] = diverging  # of a limit and the unit
    family: str = "phase"  # quantities of one family share the limit and can be compared
    finest: float = 0.01  # lowest limit: a lower one would show noise in full colours
    shown_percent: float = 99.5  # of the values that lie within the limit
    captions: Callable[[Floats], list[tuple[str, ...]]] = _phase_captions  # of maps: wordings, longest first
    summary: Callable[[Floats, str], str] = _phase_summary  # of all maps (view_row, view_column, row, column)
    value: Callable[[float, str], str] = lambda value, unit: f"{signed(value)} {unit}"  # of one value

    @property
    def has_unit(self) -> bool:
        """True for a phase, False for a ratio."""
        return self.family != "intensity"

    def limit(self, maps: Floats) -> float:
        """Return the limit that the scale needs; NaN if all maps are NaN."""
        known = np.abs(maps[np.isfinite(maps)])
        if not known.size:
            return float("nan")
        last = math.ceil(self.shown_percent / 100 * (known.size - 1))  # np.percentile takes ten times as long
        return float(np.partition(known, last)[last])


def number(value: float, digits: int = 3) -> str:
    """Format a number with significant digits, so that small ones do not become zero; NaN is a dash.

    Very small and very large numbers have an exponent.
    """
    if not math.isfinite(value):
        return NOTHING
    if value == 0:
        return "0"
    rounded = float(f"{value:.{digits - 1}e}")
    decimals = digits - 1 - math.floor(math.log10(abs(rounded)))
    is_plain = decimals <= _MOST_DECIMALS and abs(rounded) < 1e12
    text = f"{rounded:.{max(decimals, 0)}f}" if is_plain else f"{rounded:.1e}"
    return text.replace("-", "\N{MINUS SIGN}")


def with_error(value: float, sigma: float) -> tuple[str, str]:
    """Format a value with its sign and its error, which has two digits; both end at the same decimal."""
    if not (math.isfinite(value) and sigma > 0):
        return signed(value), number(sigma, 2)
    decimals = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))
    if not 0 <= decimals <= _MOST_DECIMALS:
        return signed(value), number(sigma, 2)
    return f"{value:+.{decimals}f}".replace("-", "\N{MINUS SIGN}"), f"{sigma:.{decimals}f}"


def percent(share: float, decimals: int = 0) -> str:
    """Format a share of 1 in percent."""
    return f"{100 * share:.{decimals}f} %"


def signed(value: float) -> str:
    """Format a number with its sign."""
    return f"+{number(value)}" if value > 0 else number(value)


def millimetres(position_m: float) -> str:
    """Format a field position in mm."""
    return f"{position_m * 1e3:+.2f}".replace("-", "\N{MINUS SIGN}").replace("+0.00", "0")


def place(x_m: float, y_m: float) -> tuple[str, ...]:
    """Format the field position of a view: wordings, longest first."""
    x, y = millimetres(x_m), millimetres(y_m)
    return f"x {x}  y {y} mm", f"{x}, {y} mm", f"{x}, {y}"


def _wordings(name: str, value: str, more: str) -> tuple[str, ...]:
    return f"{name} {value}   {more}", f"{name} {value}", value


def _intensity_captions(intensities: Floats) -> list[tuple[str, ...]]:
    middles = intensities[:, intensities.shape[1] // 2, intensities.shape[2] // 2].tolist()
    both = zip(middles, intensities.max(axis=(1, 2)).tolist(), strict=True)
    return [_wordings("Strehl", number(middle), f"peak {number(peak)}") for middle, peak in both]


def _sigma_captions(sigmas: Floats) -> list[tuple[str, ...]]:
    most = np.max(sigmas, axis=(1, 2), initial=-np.inf, where=np.isfinite(sigmas)).tolist()
    both = zip(sigmas, most, strict=True)
    return [_wordings("mean", number(_mean(sigma)), f"max {number(each)}") for sigma, each in both]


def _mean(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


PRESENTATIONS = {
    Quantity.WAVEFRONT: Presentation("Wavefront of each view"),
    Quantity.PSF: Presentation(
        about="Point-spread function of each view, on a square-root scale",
        scale=bright,
        family="intensity",
        finest=1e-4,
        shown_percent=100.0,
        captions=_intensity_captions,
        summary=lambda _maps, _unit: "1 = perfect peak",
        value=lambda value, _: f"{number(value)} of the peak without aberration",
    ),
    Quantity.MEASURED: Presentation("Fitted wavefront plus the slope residuals, integrated from lenslet to lenslet"),
    Quantity.FITTED: Presentation("Pupil modes fitted to each view"),
    Quantity.DIFFERENCE: Presentation(
        about="Measured minus fitted: noise and finer detail than the pupil modes resolve", family="difference"
    ),
    Quantity.UNCERTAINTY: Presentation(
        about="Error bar of each view's wavefront: noise, prior and systematic errors",
        scale=uncertain,
        family="uncertainty",
        finest=0.001,
        captions=_sigma_captions,
        summary=lambda maps, unit: f"1\N{GREEK SMALL LETTER SIGMA}, mean {number(_mean(maps))} {unit}",
        value=lambda value, unit: f"{number(value)} {unit}",
    ),
}
