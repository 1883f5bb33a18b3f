"""A map painted as a surface that the mouse turns."""

import math

import numpy as np
from PyQt6.QtCore import QPointF
from PyQt6.QtGui import QColor, QMouseEvent, QPainter, QPaintEvent, QPen, QPolygonF
from PyQt6.QtWidgets import QWidget

from app.gui.view_grid import Maps
from app.results.pictures import project_surface
from reconstruction.arrays import Floats

_TURN_RAD = 0.01  # for each pixel of a drag
_LINED = 41  # rows or columns; finer surfaces have no lines
_EDGE = QColor(0, 0, 0, 60)


class SurfaceView(QWidget):
    """Paints one map; a drag turns it."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.azimuth_rad, self.elevation_rad = 0.6, 0.6
        self._maps: Maps | None = None
        self._values: Floats = np.zeros((0, 0))
        self._from = QPointF()
        self.setMinimumSize(160, 140)
        self.setToolTip("Drag to turn the surface")

    def show_map(self, maps: Maps | None, values: Floats) -> None:
        """Show the map (row, column) of one view, or nothing."""
        self._maps, self._values = maps, values
        self.update()

    def paintEvent(self, _: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        """Paint the faces, the farthest first."""
        maps, values = self._maps, self._values
        if maps is None or min(values.shape) < 2:
            return
        limit = max(abs(maps.scale.low), abs(maps.scale.high))
        surface = project_surface(values, limit, azimuth_rad=self.azimuth_rad, elevation_rad=self.elevation_rad)
        colours = maps.scale.pixels(surface.values)
        corners = surface.corners * (min(self.width(), self.height() * 1.4) / 1.5)
        corners += (self.width() / 2, self.height() / 2)
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        is_lined = max(values.shape) <= _LINED
        for face, colour, brightness in zip(corners, colours, surface.brightness, strict=True):
            red, green, blue = ((int(colour) >> shift & 255) * brightness for shift in (16, 8, 0))
            shaded = QColor(int(red), int(green), int(blue))
            painter.setBrush(shaded)
            painter.setPen(QPen(_EDGE if is_lined else shaded, 1))
            painter.drawPolygon(QPolygonF([QPointF(x, y) for x, y in face]))

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        """Begin to turn."""
        if event is not None:
            self._from = event.position()

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        """Turn the surface."""
        if event is None:
            return
        step, self._from = event.position() - self._from, event.position()
        self.azimuth_rad -= _TURN_RAD * step.x()
        self.elevation_rad = min(max(self.elevation_rad + _TURN_RAD * step.y(), 0.1), math.pi / 2)
        self.update()
