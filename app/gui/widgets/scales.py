"""Scales of a display: colours of values with the numbers beside their bar; limits that follow the data in steps."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray

from app.results.pictures import Pixels, step_above
from reconstruction.arrays import Floats

MAGNIFICATIONS = (1.0, 2.0, 5.0)
RANGES = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # finer: a map always uses most of its colours
_FILL = 0.8  # the scale falls only if the next lower step is filled no further than this
_HALVES, _FIFTHS = (0.0, 0.25, 0.5, 0.75, 1.0), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_ROOTS = (0.0, 0.1, 0.25, 0.5, 1.0)  # well apart on a square-root scale


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
        """Return the colours of values, the same shape; NaN is transparent."""
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


def diverging(limit: float, unit: str = "rad") -> ColourScale:
    """Return the scale of phases from -limit to +limit: blue, white, red."""
    return ColourScale("CET-D1", -limit, limit, unit, _HALVES, is_signed=True)


def uncertain(limit: float, unit: str = "rad") -> ColourScale:
    """Return the scale of standard deviations from 0 to the limit."""
    return ColourScale("viridis", 0.0, limit, unit, _FIFTHS)


def bright(limit: float, _: str = "") -> ColourScale:
    """Return the scale of intensities from 0 to the limit; its square root shows faint light."""
    return ColourScale("inferno", 0.0, limit, "\N{SQUARE ROOT} scale", _ROOTS, power=0.5)


@lru_cache
def colour_table(colours: str, count: int = 255) -> Pixels:
    """Colours from low to high, (colour,), of "grey" or a map of pyqtgraph."""
    rgb: NDArray[np.uint8] = np.repeat(np.linspace(0, 255, count).round().astype(np.uint8), 3).reshape(-1, 3)
    if colours != "grey":
        rgb = pg.colormap.get(colours).getLookupTable(nPts=count)[:, :3]
    return np.uint32(0xFF000000) | (rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32))


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
