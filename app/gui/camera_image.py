"""The camera's frame as an image item: pyqtgraph's own converts it twice, Qt's part in threads that wait for a core."""

from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PyQt6.QtCore import QRectF
from PyQt6.QtGui import QImage, QPainter

from app.gui.colours import colour_table
from app.results.shades import Pixels, shaded

_SHADES = 256


class CameraImage(pg.GraphicsObject):  # type: ignore[misc] # ships no types
    """Shows counts in the colours between a black and a white level; pixel centres are at integers."""

    def __init__(self, view: pg.ViewBox) -> None:
        """Add an item without an image to a view."""
        super().__init__()
        self.pixels: Pixels = np.zeros((0, 0), np.uint32)  # as shown
        self._image = QImage()
        self._table = colour_table("grey", _SHADES)
        view.addItem(self)

    def show_counts(self, counts: NDArray[np.integer[Any]], black: float, white: float) -> None:
        """Show the counts of a frame (row, column)."""
        if counts.shape != self.pixels.shape:
            self.prepareGeometryChange()
        self.pixels = shaded(counts, black, white, self._table)  # the image refers to its memory
        rows, columns = counts.shape
        memory: Any = self.pixels.data
        self._image = QImage(memory, columns, rows, 4 * columns, QImage.Format.Format_RGB32)
        self.update()

    def use_colours(self, name: str) -> None:
        """Show the next frames in grey or the colours of a map of pyqtgraph."""
        self._table = colour_table(name, _SHADES)

    def boundingRect(self) -> QRectF:  # noqa: N802 - Qt's name
        """Return the area of the pixels."""
        rows, columns = self.pixels.shape
        return QRectF(-0.5, -0.5, columns, rows)

    def paint(self, painter: QPainter, *_: object) -> None:
        """Paint the image."""
        painter.drawImage(self.boundingRect(), self._image)
