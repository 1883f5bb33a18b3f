"""Titled plots in the colours of the window."""

import math

import numpy as np
import pyqtgraph as pg
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor, QFontMetrics
from PyQt6.QtWidgets import QApplication, QWidget

from app.gui.widgets import theme
from app.gui.widgets.copies import as_table
from app.gui.widgets.layouts import column, row, unfocused
from app.gui.widgets.texts import ElidedLabel, colour_text, label

_STALE = 0.4  # opacity of curves that may be outdated


class Canvas(pg.GraphicsView):  # type: ignore[misc] # pyqtgraph declares no types
    """A graphics view on the background of the theme."""

    def __init__(self) -> None:
        super().__init__()
        theme.follow(self, lambda: self.setBackground(theme.BACKGROUND))


class _Axis(pg.AxisItem):  # type: ignore[misc] # pyqtgraph declares no types
    """An axis whose numbers never touch, and have the minus sign of all other numbers."""

    def tickValues(  # noqa: N802 - pyqtgraph's name
        self, low: float, high: float, size: float
    ) -> list[tuple[float, list[float]]]:
        """Return spacing and values of each level; every other number or fewer if all have no space."""
        levels: list[tuple[float, list[float]]] = super().tickValues(low, high, size)
        if not levels or not len(levels[0][1]):
            return levels
        spacing, values = levels[0]
        font = QFontMetrics(QApplication.font())
        is_upright = self.orientation == "left"
        widest = max(map(font.horizontalAdvance, self.tickStrings(list(values), self.scale, spacing)))
        needed_px = len(values) * (font.height() if is_upright else widest + font.horizontalAdvance("00"))
        step = math.ceil(needed_px / max(size, 1.0))
        return levels if step == 1 else [(step * spacing, list(values[::step]))]

    def tickStrings(  # noqa: N802 - pyqtgraph's name
        self, values: list[float], scale: float, spacing: float
    ) -> list[str]:
        return [text.replace("-", "\N{MINUS SIGN}") for text in super().tickStrings(values, scale, spacing)]


class Plot(QWidget):
    """A titled plot without zoom or pan."""

    def __init__(
        self, title: str, bottom: str | None, keys: tuple[tuple[str, QColor], ...] = (), widest: str = "0.0"
    ) -> None:
        """Make an empty plot with a legend of `keys`, space for the `widest` number at the left, and a text below."""
        super().__init__()
        self.curves: list[pg.PlotCurveItem] = []
        self._is_clear = False
        self.title = ElidedLabel("title", title, lines=2)
        self.graphics = Canvas()
        self.graphics.setMinimumSize(120, 4 * self.fontMetrics().height())
        unfocused(self.graphics)
        self.view = pg.ViewBox(enableMenu=False, enableMouse=False, defaultPadding=0)
        sides = ("left",) if bottom is None else ("left", "bottom")
        self.axes = axes = {side: _Axis(side, linkView=self.view) for side in sides}
        for axis in axes.values():
            axis.enableAutoSIPrefix(enable=False)
            axis.setStyle(tickLength=4, tickTextOffset=3)
        font = self.fontMetrics()
        axes["left"].setWidth(font.horizontalAdvance(widest) + 12)
        if bottom is not None:
            axes["bottom"].setHeight(2 * font.height() + 6)
            axes["bottom"].setLabel(bottom)
        theme.follow(self, self._colour_axes)
        grid = pg.GraphicsLayout()
        grid.setContentsMargins(0, font.height() // 2, 12, 4)  # pyqtgraph draws the label a little below its axis
        grid.setSpacing(0)
        grid.addItem(axes["left"], 0, 0)
        grid.addItem(self.view, 0, 1)
        if bottom is not None:
            grid.addItem(axes["bottom"], 1, 1)
        self.graphics.setCentralItem(grid)
        header = row((self.title, 1), spacing=8)
        for text, colour in keys:
            key = label(text)
            colour_text(key, colour)
            header.addWidget(key)
        column(header, (self.graphics, 1), spacing=2, parent=self)

    def table(self) -> str:
        """Return all curves, one below the other, as lines of tab-separated numbers."""
        heads = self.axes["bottom"].labelText if "bottom" in self.axes else "x", self.title.text()
        known = [(x, y) for x, y in (curve.getData() for curve in self.curves) if x is not None and len(x)]
        return "\n\n".join(as_table(heads, np.c_[x, y]) for x, y in known)

    def add_curve(self, colour: QColor, width: int = 2, style: Qt.PenStyle = Qt.PenStyle.SolidLine) -> pg.PlotCurveItem:
        curve = pg.PlotCurveItem(antialias=True)
        theme.follow(self, lambda: curve.setPen(pg.mkPen(colour, width=width, style=style)))
        self.view.addItem(curve)
        self.curves.append(curve)
        return curve

    def add_line(self, colour: QColor, angle: int, at: float = 0.0, **options: object) -> pg.InfiniteLine:
        """Add a dashed line through the whole plot, which does not widen its ranges."""
        line = pg.InfiniteLine(at, angle=angle, **options)
        theme.follow(self, lambda: line.setPen(pg.mkPen(colour, width=1, style=Qt.PenStyle.DashLine)))
        self.view.addItem(line, ignoreBounds=True)
        return line

    def _colour_axes(self) -> None:
        for axis in self.axes.values():
            axis.setPen(theme.LINE)
            axis.setTextPen(theme.DIM)
            axis.setLabel(axis.labelText, color=theme.DIM.name())

    def show_stale(self, *, is_stale: bool) -> None:
        self.view.childGroup.setOpacity(_STALE if is_stale else 1.0)

    def clear_curves(self) -> None:
        for curve in self.curves:
            curve.setData([], [])

    def clear(self) -> None:
        """Show neither curves nor numbers until the ranges are set again."""
        self.clear_curves()
        for axis in self.axes.values():
            axis.setTicks([[]])
        self._is_clear = True

    def set_ranges(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        if self._is_clear:
            self._is_clear = False
            for axis in self.axes.values():
                axis.setTicks(None)  # those of the ranges
        self.view.setRange(xRange=x, yRange=y, padding=0)
