"""How each quantity is shown: its colours, and the words and numbers beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from app.gui.analysis import Quantity
from app.gui.colours import ColourScale, bright, diverging, uncertain
from reconstruction.arrays import Floats
from reconstruction.wavefront import peak_to_valley, rms

NOTHING = "\N{EN DASH}"
_SHOWN_PERCENT = 99.5  # of the lenslets lie within the colour scale


@dataclass(frozen=True, slots=True)
class Presentation:
    """How one quantity is shown."""

    about: str  # what it is, for the tool tip of its name
    scale: Callable[[float], ColourScale]  # for a limit
    family: str  # those of one family share the limit, so that they can be compared
    finest: float  # no finer limit: it would show noise in full colours
    shown_percent: float  # of the values that lie within the limit
    caption: Callable[[Floats], tuple[str, ...]]  # of one map (row, column), in several wordings, the longest first
    summary: Callable[[Floats], str]  # of all maps (view_row, view_column, row, column)
    value: str  # the format of one value

    def limit(self, maps: Floats) -> float:
        """How far the scale must reach; NaN where nothing is known."""
        known = np.abs(maps[np.isfinite(maps)])
        return float(np.percentile(known, self.shown_percent)) if known.size else float("nan")


def number(value: float, decimals: int = 2) -> str:
    """A number, or a dash where there is none."""
    return f"{value:.{decimals}f}" if np.isfinite(value) else NOTHING


def millimetres(position_m: float) -> str:
    """A field position."""
    return f"{position_m * 1e3:+.2f}".replace("-", "\N{MINUS SIGN}").replace("+0.00", "0")


def place(x_m: float, y_m: float) -> tuple[str, ...]:
    """Where a view lies in the field, in several wordings, the longest first."""
    x, y = millimetres(x_m), millimetres(y_m)
    return f"x {x}  y {y} mm", f"{x}, {y} mm", f"{x}, {y}"


def _wordings(name: str, value: str, more: str) -> tuple[str, ...]:
    return f"{name} {value}   {more}", f"{name} {value}", value


def _phase_caption(phase: Floats, decimals: int = 2) -> tuple[str, ...]:
    pv = number(float(peak_to_valley(phase)), decimals)
    return _wordings("RMS", number(float(rms(phase)), decimals), f"PV {pv}")


def _intensity_caption(intensity: Floats) -> tuple[str, ...]:
    middle = intensity[intensity.shape[0] // 2, intensity.shape[1] // 2]
    return _wordings("Strehl", number(float(middle), 3), f"peak {number(float(intensity.max()), 3)}")


def _sigma_caption(sigma: Floats) -> tuple[str, ...]:
    return _wordings("mean", number(_mean(sigma), 3), f"most {number(_most(sigma), 3)}")


def _mean(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _most(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else float("nan")


def _phase(about: str) -> Presentation:
    return Presentation(
        about=about,
        scale=diverging,
        family="phase",
        finest=0.01,
        shown_percent=_SHOWN_PERCENT,
        caption=_phase_caption,
        summary=lambda maps: f"mean RMS {number(_mean(rms(maps)))} rad",
        value="{:+.2f} rad",
    )


PRESENTATIONS = {
    Quantity.WAVEFRONT: _phase("The wavefront at each view of the field"),
    Quantity.PSF: Presentation(
        about="The point-spread function at each view: how a point of the object is imaged",
        scale=bright,
        family="intensity",
        finest=1e-4,
        shown_percent=100.0,
        caption=_intensity_caption,
        summary=lambda _: "ideal peak 1",
        value="{:.4f} of the ideal peak",
    ),
    Quantity.MEASURED: _phase(
        "What the slopes of each view say: the fit, and what it leaves of them integrated lenslet by lenslet"
    ),
    Quantity.FITTED: _phase("The pupil modes fitted to each view"),
    Quantity.DIFFERENCE: Presentation(
        about="Measured minus fitted: noise, and what the pupil modes are too few for",
        scale=diverging,
        family="difference",
        finest=0.01,
        shown_percent=_SHOWN_PERCENT,
        caption=partial(_phase_caption, decimals=3),
        summary=lambda maps: f"mean RMS {number(_mean(rms(maps)), 3)} rad",
        value="{:+.3f} rad",
    ),
    Quantity.UNCERTAINTY: Presentation(
        about="Standard deviation of each view's wavefront, from the camera's noise",
        scale=uncertain,
        family="uncertainty",
        finest=0.001,
        shown_percent=_SHOWN_PERCENT,
        caption=_sigma_caption,
        summary=lambda maps: f"1\N{GREEK SMALL LETTER SIGMA}, mean {number(_mean(maps), 3)} rad",
        value="{:.3f} rad",
    ),
}
