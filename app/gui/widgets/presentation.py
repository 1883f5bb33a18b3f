"""Presentation of numbers: colour scales, limits that follow the data, and formats."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray

from app.results.pictures import Pixels, step_above
from app.results.view_maps import Quantity
from reconstruction.arrays import Floats

MAGNIFICATIONS = (1.0, 2.0, 5.0)
RANGES = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # finer: a map always uses most of its colours
_FILL = 0.8  # the scale falls only if the next lower step is filled no further than this
_HALVES, _FIFTHS = (0.0, 0.25, 0.5, 0.75, 1.0), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_ROOTS = (0.0, 0.1, 0.25, 0.5, 1.0)  # well apart on a square-root scale
NOTHING = "\N{EN DASH}"
_MOST_DECIMALS = 6
_COUNTS = 1 << 16  # that a pixel of a camera can have


@dataclass(frozen=True, slots=True)
class ColourScale:
    """Maps values from `low` to `high` to colours; values beyond take the colour of the end."""

    colours: str  # name of a pyqtgraph colour map
    low: float
    high: float
    title: str  # above the colour bar, usually the unit
    numbered: tuple[float, ...]  # fractions of the bar, 0 ... 1, that have numbers
    power: float = 1.0  # of the fraction: 0.5 is a square-root scale
    is_signed: bool = False

    def pixels(self, values: Floats) -> Pixels:
        """Return the colours (...) of values (...), which are in the unit of the scale; NaN is transparent."""
        known = np.isfinite(values)
        fraction = np.clip((np.where(known, values, self.low) - self.low) / (self.high - self.low), 0, 1) ** self.power
        table = colour_table(self.colours)
        return np.where(known, table[np.rint(fraction * (len(table) - 1)).astype(np.intp)], np.uint32(0))

    @property
    def ticks(self) -> tuple[tuple[float, str], ...]:
        """Positions on the bar, 0 ... 1, and their numbers."""
        span = self.high - self.low
        return tuple((part**self.power, self._text(self.low + span * part)) for part in self.numbered)

    def _text(self, value: float) -> str:
        digits = ".0f" if abs(value) >= 1000 else ".3g"
        text = f"{value:+{digits}}" if self.is_signed else f"{value:{digits}}"
        return text.replace("-", "\N{MINUS SIGN}") if value else "0"


def diverging(limit: float, unit: str) -> ColourScale:
    """Return the scale of phases from -limit to +limit: blue, white, red."""
    return ColourScale("CET-D1", -limit, limit, unit, _HALVES, is_signed=True)


def of_counts(limit: float) -> ColourScale:
    """Return the scale of counts from 0 to the limit."""
    return ColourScale("inferno", 0.0, limit, "", _HALVES[::2])


@lru_cache
def colour_table(colours: str, count: int = 255) -> Pixels:
    """Colours from low to high, (colour,), of "grey" or a map of pyqtgraph."""
    rgb: NDArray[np.uint8] = np.repeat(np.linspace(0, 255, count).round().astype(np.uint8), 3).reshape(-1, 3)
    if colours != "grey":
        rgb = pg.colormap.get(colours).getLookupTable(nPts=count)[:, :3]
    return np.uint32(0xFF000000) | (rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32))


@lru_cache(maxsize=4)
def count_colours(colours: str, black: float, white: float, clip_level: int | None, clipped: int) -> Pixels:
    """Colour of each count of a camera, (65536,): `colours` from black to white, `clipped` from `clip_level` on."""
    table = colour_table(colours, 256)
    place = np.clip((np.arange(_COUNTS) - black) / (white - black), 0, 1) * (len(table) - 1)
    found: Pixels = table[np.rint(place).astype(np.intp)]
    if clip_level is not None:
        found[clip_level:] = clipped
    return found


class AdaptiveScale:
    """A limit that rises at once when exceeded and falls only when clearly too large."""

    def __init__(self, steps: tuple[float, ...] = RANGES) -> None:
        """Take values from `steps`, which cover one decade, times any power of ten."""
        self._steps = steps
        self.is_set = False
        self.value = 1.0

    def follow(self, needed: float) -> float:
        """Adapt to `needed` and return the limit; ignore values that are not positive and finite."""
        if math.isfinite(needed) and needed > 0:
            if needed > self.value or not self.is_set:
                self.is_set = True
                self.value = step_above(needed, self._steps)
            else:
                self.value = min(self.value, step_above(needed / _FILL, self._steps))
        return self.value

    def use(self, value: float) -> None:
        """Take a limit as it is, until another is needed."""
        self.is_set, self.value = True, value


@dataclass(frozen=True, slots=True)
class Presentation:
    """Display format of one quantity; the defaults are those of a phase."""

    about: str  # tool tip
    scale: Callable[[float, str], ColourScale] = diverging  # of a limit and the unit
    family: str = "phase"  # quantities of one family share the limit and can be compared
    finest: float = 0.01  # lowest limit: a lower one would show noise in full colours
    shown_percent: float = 99.5  # of the values that lie within the limit
    names: tuple[str, str] = ("RMS", "PV")  # of the numbers of a view, see `ViewNumbers`
    summary: Callable[[float, str], str] = lambda mean, unit: f"Mean RMS {number(mean)} {unit}"  # of all maps
    value: Callable[[float, str], str] = lambda value, unit: f"{signed(value)} {unit}"  # of one value

    @property
    def has_unit(self) -> bool:
        """True for a phase, False for a ratio."""
        return self.family != "intensity"

    def caption(self, first: float, second: float, sigma: float, unit: str) -> tuple[str, ...]:
        """Format the numbers of a view, the first with its error if that is known: wordings, longest first."""
        with_unit = f"{unit if self.has_unit else ''}"
        text = number(first) + f" \N{PLUS-MINUS SIGN} {number(sigma, 1)}" * (sigma > 0)
        full = f"{self.names[0]} {text} {with_unit}".rstrip()
        return f"{full}, {self.names[1]} {number(second)}", full, f"{text} {with_unit}".rstrip(), text, number(first)

    def limit(self, maps: Floats) -> float:
        """Return the limit that the scale of maps (...) needs, in their unit; NaN if all are NaN."""
        known = np.abs(maps[np.isfinite(maps)])
        if not known.size:
            return float("nan")
        last = math.ceil(self.shown_percent / 100 * (known.size - 1))  # np.percentile takes ten times as long
        return float(np.partition(known, last)[last])


def number(value: float, digits: int = 3) -> str:
    """Format a number with significant digits, very small and very large ones with an exponent; NaN is a dash."""
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


def position_texts(x_m: float, y_m: float) -> tuple[str, ...]:
    """Format the field position of a view: wordings, longest first."""
    x, y = (f"{at_m * 1e3:+.2f}".replace("-", "\N{MINUS SIGN}").replace("+0.00", "0") for at_m in (x_m, y_m))
    return f"x {x}  y {y} mm", f"{x}, {y} mm", f"{x}, {y}"


PRESENTATIONS = {
    Quantity.WAVEFRONT: Presentation("Wavefront of each view"),
    Quantity.PSF: Presentation(
        about="Point-spread function of each view, on a square-root scale",
        scale=lambda limit, _: ColourScale("inferno", 0.0, limit, "\N{SQUARE ROOT} scale", _ROOTS, power=0.5),
        family="intensity",
        finest=1e-4,
        shown_percent=100.0,
        names=("Strehl", "peak"),
        summary=lambda _mean, _unit: "1 = perfect peak",
        value=lambda value, _: f"{number(value)} of the peak without aberration",
    ),
    Quantity.RESIDUAL: Presentation(
        about="Measured minus fitted slopes, integrated: noise and finer detail than the pupil modes resolve",
        family="residual",
    ),
    Quantity.UNCERTAINTY: Presentation(
        about="Error bar of each view's wavefront: noise, prior and systematic errors",
        scale=lambda limit, unit: ColourScale("viridis", 0.0, limit, unit, _FIFTHS),
        family="uncertainty",
        finest=0.001,
        names=("mean", "max"),
        summary=lambda mean, unit: f"1\N{GREEK SMALL LETTER SIGMA}, mean {number(mean)} {unit}",
        value=lambda value, unit: f"{number(value)} {unit}",
    ),
}
