"""The wavefront at every view of the field, side by side as the views lie in the field, on one colour scale."""

from __future__ import annotations

import numpy as np
from PyQt6.QtCore import Qt
from PyQt6.QtWidgets import QHBoxLayout, QVBoxLayout, QWidget

from app.gui.scale import RANGES, SteppedScale
from app.gui.view_grid import ViewGrid
from app.gui.widgets import ElidedLabel, label, toggle
from reconstruction.geometry import Floats
from reconstruction.wavefront import Wavefront, peak_to_valley, rms

_FINEST_RAD = 0.01  # no finer scale: it would show noise in full colours
_SHOWN_PERCENT = 99.5  # of the lenslets lie within the colour scale


class WavefrontPanel(QWidget):
    """Shows wavefronts; where none is known it says so."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._wavefront: Wavefront | None = None
        self._limit = SteppedScale(RANGES)
        self._summary = ElidedLabel("dim")
        self._summary.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.hold_scale = toggle("Hold scale", "Keep the colour scale, instead of letting it follow (H)")
        self.grid = ViewGrid()
        header = QHBoxLayout()
        header.addWidget(label("Wavefront over the field", "title"))
        header.addWidget(self._summary, 1)
        header.addSpacing(12)
        header.addWidget(self.hold_scale)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(header)
        layout.addWidget(self.grid, 1)

    def show_wavefront(self, wavefront: Wavefront | None) -> None:
        """Show the views of a wavefront, or that there is none."""
        if wavefront is None and self._wavefront is None:
            return
        self._wavefront = wavefront
        if wavefront is not None:
            if not self.hold_scale.isChecked():
                self._limit.follow(max(_reach(wavefront.views), _FINEST_RAD))
            self.grid.show_views(wavefront.views, self._limit.value)
        else:
            self.grid.show_nothing()

    def update_text(self) -> None:
        """Write the numbers under the views."""
        if self._wavefront is None:
            self._summary.setText("")
            self.grid.set_captions({})
            return
        views, field = self._wavefront.views, self._wavefront.field
        rms_rad, pv_rad = rms(views), peak_to_valley(views)
        x, y = ([_millimetres(float(at_m)) for at_m in axis] for axis in (field.view_x_m, field.view_y_m))
        self.grid.set_captions(
            {
                (row, column): (
                    f"RMS {_number(float(rms_rad[row, column]))}   PV {_number(float(pv_rad[row, column]))}",
                    f"x {x[column]}  y {y[row]} mm",
                )
                for row, column in np.ndindex(views.shape[:2])
            }
        )
        known_rad = rms_rad[np.isfinite(rms_rad)]  # a view outside the field has none
        mean_rad = float(np.mean(known_rad)) if known_rad.size else np.nan
        self._summary.setText(f"mean RMS {_number(mean_rad)} rad")


def _reach(views: Floats) -> float:
    """How far the colour scale must reach, rad; NaN where nothing is known."""
    known = np.abs(views[np.isfinite(views)])
    return float(np.percentile(known, _SHOWN_PERCENT)) if known.size else np.nan


def _number(value_rad: float) -> str:
    return f"{value_rad:.2f}" if np.isfinite(value_rad) else "\N{EN DASH}"


def _millimetres(position_m: float) -> str:
    return f"{position_m * 1e3:+.2f}".replace("-", "\N{MINUS SIGN}").replace("+0.00", "0")
