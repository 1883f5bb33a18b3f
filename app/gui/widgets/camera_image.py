"""The camera's frame and its clipped pixels as image items.

pyqtgraph's own converts a frame twice, Qt's part in threads that wait for a core.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PyQt6.QtCore import QEvent, QRectF
from PyQt6.QtGui import QImage, QMouseEvent, QPainter

from app.gui.widgets import theme
from app.gui.widgets.plot import Canvas
from app.gui.widgets.scales import colour_table
from app.results.pictures import FrameStatistics, Pixels, shaded
from drivers.interface import Frame

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


class ClippedPixels(pg.ImageItem):  # type: ignore[misc] # ships no types
    """Paints clipped pixels red over the camera image."""

    def __init__(self, view: pg.ViewBox) -> None:
        """Add an item without pixels to a view."""
        super().__init__(axisOrder="row-major")  # pyqtgraph's default is column-major
        self.setLookupTable(np.array([[0, 0, 0, 0], theme.RED_ON_IMAGE.getRgb()], np.uint8))
        self.setZValue(0.5)
        view.addItem(self)

    def show_of(self, frame: Frame, known: FrameStatistics | None) -> None:
        """Show those of a frame, if there were any when the statistics were taken."""
        self.setVisible(known is not None and known.clipped_share > 0)
        if known is not None and self.isVisible():
            clipped = frame.pixels >= known.clip_level
            self.setImage(clipped.view(np.uint8), autoLevels=False, levels=(0, 1))
            self.setRect(QRectF(-0.5, -0.5, *clipped.shape[::-1]))


class Picture(Canvas):
    """The view of the camera image; tells of double clicks, and that the pointer has left."""

    def __init__(self, double_clicked: Callable[[], None], left: Callable[[], None]) -> None:
        super().__init__()
        self._double_clicked, self._left = double_clicked, left

    def mouseDoubleClickEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        """Tell of a double click."""
        super().mouseDoubleClickEvent(event)
        self._double_clicked()

    def leaveEvent(self, event: QEvent | None) -> None:  # noqa: N802 - Qt's name
        """Tell that the pointer has left."""
        super().leaveEvent(event)
        self._left()
