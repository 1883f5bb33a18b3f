"""From values to colours, and the numbers beside a colour bar."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray

from reconstruction.arrays import Floats

Pixels = NDArray[np.uint32]  # ARGB; 0 is transparent

_HALVES, _FIFTHS = (0.0, 0.25, 0.5, 0.75, 1.0), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_ROOTS = (0.0, 0.1, 0.25, 0.5, 1.0)  # well apart on a square-root scale


@dataclass(frozen=True, slots=True)
class ColourScale:
    """Which colour stands for which value, from `low` to `high`; values beyond have the colour of the end."""

    colours: str  # pyqtgraph's name of a colour map
    low: float
    high: float
    title: str  # what is written over the colour bar, the unit as a rule
    numbered: tuple[float, ...]  # how far on the way from low to high the bar has numbers
    power: float = 1.0  # of the part of the way from low to high: 0.5 is a square-root scale
    is_signed: bool = False

    def pixels(self, values: Floats) -> Pixels:
        """Colours of the values, the same shape; what is NaN is transparent."""
        known = np.isfinite(values)
        fraction = np.clip((np.where(known, values, self.low) - self.low) / (self.high - self.low), 0, 1) ** self.power
        table = _table(self.colours)
        return np.where(known, table[np.rint(fraction * (len(table) - 1)).astype(np.intp)], np.uint32(0))

    @property
    def bar(self) -> Pixels:
        """The colours from low to high, (colour,)."""
        return _table(self.colours)

    @property
    def ticks(self) -> tuple[tuple[float, str], ...]:
        """How far up the bar there are numbers, 0 ... 1, and which."""
        span = self.high - self.low
        return tuple((part**self.power, self._text(self.low + span * part)) for part in self.numbered)

    def _text(self, value: float) -> str:
        text = f"{value:+.3g}" if self.is_signed else f"{value:.3g}"
        return text.replace("-", "\N{MINUS SIGN}") if value else "0"


def diverging(limit_rad: float) -> ColourScale:
    """Blue, white, red: phases from -limit to +limit."""
    return ColourScale("CET-D1", -limit_rad, limit_rad, "rad", _HALVES, is_signed=True)


def uncertain(limit_rad: float) -> ColourScale:
    """Standard deviations from 0 to the limit."""
    return ColourScale("viridis", 0.0, limit_rad, "rad", _FIFTHS)


def bright(limit: float) -> ColourScale:
    """Intensities from 0 to the limit, on a square-root scale, which lets faint light be seen."""
    return ColourScale("inferno", 0.0, limit, "\N{SQUARE ROOT}", _ROOTS, power=0.5)


@lru_cache
def _table(colours: str) -> Pixels:
    """The colours of a map, from low to high: (colour,)."""
    rgb: NDArray[np.uint8] = pg.colormap.get(colours).getLookupTable(nPts=255)[:, :3]
    return np.uint32(0xFF000000) | (rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32))
