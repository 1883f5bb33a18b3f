"""Two curves of an analysis: the modulation transfer of a view, and how wavefronts differ over the field."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QHBoxLayout, QVBoxLayout, QWidget

from app.gui import theme
from app.gui.scale import RANGES, SteppedScale
from app.gui.widgets import ElidedLabel, label, unfocused
from reconstruction.arrays import Floats
from reconstruction.quality.image_quality import Mtf
from reconstruction.quality.isoplanatism import Isoplanatism

_NO_VALUES = np.zeros(0)
_SIDES = ("left", "bottom")


class _Plot(QWidget):
    """A titled plot that only shows: it neither zooms nor moves."""

    def __init__(self, title: str, bottom: str, keys: tuple[tuple[str, QColor], ...], parent: QWidget | None) -> None:
        super().__init__(parent)
        self.title = ElidedLabel("title")
        self.title.setText(title)
        self._graphics = pg.GraphicsView(background=theme.BACKGROUND)
        self._graphics.setMinimumSize(150, 5 * self.fontMetrics().height())
        unfocused(self._graphics)
        self._view = pg.ViewBox(enableMenu=False, enableMouse=False, defaultPadding=0)
        self._axes = axes = {
            side: pg.AxisItem(side, linkView=self._view, pen=theme.LINE, textPen=theme.DIM) for side in _SIDES
        }
        for axis in axes.values():
            axis.enableAutoSIPrefix(enable=False)
            axis.setStyle(tickLength=4, tickTextOffset=3)
        font = self.fontMetrics()
        axes["left"].setWidth(font.horizontalAdvance("0.0") + 12)
        axes["bottom"].setHeight(2 * font.height() + 6)
        axes["bottom"].setLabel(bottom, color=theme.DIM.name())
        grid = pg.GraphicsLayout()
        grid.setContentsMargins(0, 5, 12, 0)
        grid.setSpacing(0)
        grid.addItem(axes["left"], 0, 0)
        grid.addItem(self._view, 0, 1)
        grid.addItem(axes["bottom"], 1, 1)
        self._graphics.setCentralItem(grid)
        header = QHBoxLayout()
        header.setSpacing(8)
        header.addWidget(self.title, 1)
        for text, colour in keys:
            key = label(text)
            key.setStyleSheet(f"color: {colour.name()};")
            header.addWidget(key)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(2)
        layout.addLayout(header)
        layout.addWidget(self._graphics, 1)

    def _add_curve(
        self, colour: QColor, width: int = 2, style: Qt.PenStyle = Qt.PenStyle.SolidLine
    ) -> pg.PlotCurveItem:
        curve = pg.PlotCurveItem(pen=pg.mkPen(colour, width=width, style=style), antialias=True)
        self._view.addItem(curve)
        return curve

    def _set_ranges(self, x: float, y: float) -> None:
        self._view.setRange(xRange=(0, x), yRange=(0, y), padding=0)


class MtfPlot(_Plot):
    """Modulation transfer along x and y, from 0 to the highest frequency the pupil lets through."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(
            "MTF", "cycles per mrad", (("x", theme.ACCENT), ("y", theme.AMBER), ("limit", theme.DIM)), parent
        )
        self.setToolTip(
            "Modulation transfer of the selected view along x and y, and the limit that diffraction sets.\n"
            "Only the area of known lenslets transmits. Click a view, or use the arrow keys, to select it."
        )
        self._limits = [self._add_curve(theme.DIM, 1, Qt.PenStyle.DashLine) for _ in "xy"]
        self._curves = [self._add_curve(colour) for colour in (theme.ACCENT, theme.AMBER)]
        self._axes["left"].setTicks([[(0, "0"), (0.5, "0.5"), (1, "1")]])
        self._set_ranges(1, 1)

    def show_transfer(self, transfer: Mtf | None, where: str) -> None:
        """Show the transfer of one view, or none; `where` says which."""
        self.title.setText(f"MTF at {where}" if where else "MTF")
        if transfer is None:
            for curve in (*self._limits, *self._curves):
                curve.setData(_NO_VALUES, _NO_VALUES)
            return
        frequencies = [one / 1e3 for one in (transfer.frequency_x_per_rad, transfer.frequency_y_per_rad)]
        self._set_ranges(max(float(one[-1]) for one in frequencies), 1)
        for curve, frequency, values in zip(
            (*self._limits, *self._curves),
            (*frequencies, *frequencies),
            (transfer.limit_x, transfer.limit_y, transfer.along_x, transfer.along_y),
            strict=True,
        ):
            curve.setData(*_known(frequency, values))


class StructurePlot(_Plot):
    """RMS difference of two wavefronts over their separation in the field, with the 1 rad that ends the patch."""

    def __init__(self, parent: QWidget | None = None) -> None:
        keys = (("all", theme.ACCENT), ("no tilt", theme.GREEN))
        super().__init__("RMS difference (rad)", "separation in the field (mm)", keys, parent)
        self.setToolTip(
            "RMS difference of the wavefronts of two positions of the field, over their separation;\n"
            "the band holds all pairs. Where it reaches 1 rad, the isoplanatic patch ends.\n"
            "A difference in tilt displaces the image, what is left without it blurs it."
        )
        self._scale = SteppedScale(RANGES)
        self._curves = []
        for colour in (theme.GREEN, theme.ACCENT):
            ends = [pg.PlotCurveItem(pen=None) for _ in range(2)]
            brush = QColor(colour)
            brush.setAlpha(40)
            self._view.addItem(pg.FillBetweenItem(*ends, brush=brush))
            self._curves.append((self._add_curve(colour), *ends))
        limit = pg.InfiniteLine(
            1.0,
            angle=0,
            pen=pg.mkPen(theme.AMBER, width=1, style=Qt.PenStyle.DashLine),
            label="1 rad",
            labelOpts={"position": 0.04, "color": theme.AMBER, "anchors": [(0, 0.95), (0, 0.95)]},
        )
        self._view.addItem(limit)
        self._set_ranges(1, 1.5)

    def show_structure(self, found: Isoplanatism | None) -> None:
        """Show how wavefronts differ, or nothing."""
        if found is None:
            for items in self._curves:
                for item in items:
                    item.setData(_NO_VALUES, _NO_VALUES)
            return
        for items, curve in zip(self._curves, (found.curve_without_tilt, found.curve), strict=True):
            for item, values in zip(items, (curve.rms_rad, curve.least_rad, curve.most_rad), strict=True):
                item.setData(*_known(np.append(0, curve.separation_m * 1e3), np.append(0, values)))
        most_rad = float(np.nanmax(found.curve.most_rad, initial=1.2))  # the line at 1 rad is always seen
        self._set_ranges(float(np.max(found.curve.separation_m, initial=1e-6)) * 1e3, self._scale.follow(most_rad))


def _known(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    known = np.isfinite(y)
    return x[known], y[known]
