"""Many separate line segments over an image, drawn as they are: a curve of pyqtgraph makes a path of them first."""

from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PyQt6 import sip
from PyQt6.QtCore import QLineF, QRectF
from PyQt6.QtGui import QColor, QPainter, QPainterPath, QPen

from reconstruction.arrays import Floats

_ANYWHERE = QRectF(-1e6, -1e6, 2e6, 2e6)  # px
_SHADOW = QColor(0, 0, 0, 200)


class Segments(pg.GraphicsObject):  # type: ignore[misc] # ships no types
    """Segments given by pairs of ends; the pens are as wide at any zoom."""

    def __init__(self, view: pg.ViewBox, colour: QColor, *, alpha: int = 255, width: int = 1, shadow: int = 0) -> None:
        """Add an item without segments to a view; `shadow` is the width of a dark line below each, 0 for none."""
        super().__init__()
        colour = QColor(colour)
        colour.setAlpha(alpha)
        self._pens = [_pen(_SHADOW, shadow)] if shadow else []
        self._pens.append(_pen(colour, width))
        self.ends: Floats = np.zeros((0, 2))
        self._lines = _lines(self.ends)
        self.setZValue(1)
        view.addItem(self, ignoreBounds=True)

    def draw(self, ends: Floats) -> None:
        """Show other segments (2 * segment, xy)."""
        if ends is self.ends or np.array_equal(ends, self.ends):
            return
        self.ends, self._lines = ends, _lines(ends)
        self.update()

    def boundingRect(self) -> QRectF:  # noqa: N802 - Qt's name
        """Return where segments may lie; their true border, new in every frame, costs more than painting them."""
        return _ANYWHERE

    def shape(self) -> QPainterPath:
        """Return an empty outline: the mouse is for what lies below."""
        return QPainterPath()

    def paint(self, painter: QPainter, *_: object) -> None:
        """Paint the segments."""
        for pen in self._pens:
            painter.setPen(pen)
            painter.drawLines(self._lines)


def _pen(colour: QColor, width: int) -> QPen:
    pen = QPen(colour, width)
    pen.setCosmetic(True)
    return pen


def _lines(ends: Floats) -> Any:
    """Make Qt's array of lines, without an object for each."""
    lines: Any = sip.array(QLineF, len(ends) // 2)  # type: ignore[call-arg] # its types are those of another class
    if len(ends):
        values: NDArray[np.float64] = np.frombuffer(lines, np.float64)
        values[:] = ends.ravel()
    return lines
