"""The camera picture, in camera pixels: frame, segments over it, and drags that draw.

pyqtgraph's own image item converts a frame twice, Qt's part in threads that wait for a core.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PyQt6 import sip
from PyQt6.QtCore import QEvent, QLineF, QPointF, QRectF, Qt, pyqtSignal
from PyQt6.QtGui import QColor, QImage, QPainter

from app.gui.widgets import theme
from app.gui.widgets.plot import Canvas
from app.gui.widgets.presentation import count_colours
from app.results.pictures import Pixels
from reconstruction.arrays import Floats
from reconstruction.geometry import Lattice, Sensor, centered_steps, lenslet_centers
from reconstruction.pupil import Pupil
from reconstruction.runtime.opencv import cv2

_AROUND = [0, 1, 1, 2, 2, 3, 3, 0]  # corners at the ends of four borders
_INSET = 0.88  # size of a lost lenslet's box over that of its cell
_USUAL = 0.98  # share of the arrows that are not the longest few
_HEAD = 0.35  # length of an arrow's head, in arrow lengths
_BARBS = np.array([[[-0.9, 0.45], [-0.45, -0.9]], [[-0.9, -0.45], [0.45, -0.9]]])  # turn and shorten the shaft
_sip: Any = sip  # its types are declared incompletely

Counts = NDArray[np.uint16]


class CameraImage(pg.GraphicsObject):  # type: ignore[misc] # ships no types
    """Shows counts in colours between black and white, looked up where they are seen; pixel centres are integers."""

    def __init__(self, view: pg.ViewBox) -> None:
        super().__init__()
        self.counts: Counts = np.zeros((0, 0), np.uint16)
        self._look: tuple[str, float, float, int | None] = "grey", 0.0, 1.0, None
        view.addItem(self)

    def show_counts(
        self, counts: Counts, colours: str, black: float, white: float, clip_level: int | None = None
    ) -> None:
        """Show the counts of a frame (row, column), red from `clip_level` on."""
        if counts.shape != self.counts.shape:
            self.prepareGeometryChange()
        self.counts, self._look = counts, (colours, black, white, clip_level)
        self.update()

    def boundingRect(self) -> QRectF:  # noqa: N802 - Qt's name
        rows, columns = self.counts.shape
        return QRectF(-0.5, -0.5, columns, rows)

    def colours(self, counts: Counts) -> Pixels:
        table, found = count_colours(*self._look, theme.RED_ON_IMAGE.rgb()), np.empty(counts.shape, np.uint32)
        table.take(counts, out=found, mode="clip")  # every count is in the table; other modes copy the result
        return found

    def paint(self, painter: QPainter, *_: object) -> None:
        seen = self.viewRect().intersected(self.boundingRect())
        if seen.isEmpty():
            return
        left, top = int(seen.left() + 0.5), int(seen.top() + 0.5)
        counts = self.counts[top : math.ceil(seen.bottom() + 0.5), left : math.ceil(seen.right() + 0.5)]
        area = QRectF(left - 0.5, top - 0.5, *counts.shape[::-1])
        if (scale := abs(painter.deviceTransform().m11())) < 1:
            size = [max(round(scale * side), 1) for side in counts.shape[::-1]]
            counts = np.asarray(cv2.resize(counts, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint16)
        pixels = self.colours(counts)
        rows, columns = pixels.shape
        memory: Any = pixels.data
        painter.drawImage(area, QImage(memory, columns, rows, 4 * columns, QImage.Format.Format_RGB32))


class Picture(Canvas):
    """The view of the camera image; calls `left` when the pointer has left it."""

    def __init__(self, left: Callable[[], None]) -> None:
        super().__init__()
        self._left = left

    def leaveEvent(self, event: QEvent | None) -> None:  # noqa: N802 - Qt's name
        super().leaveEvent(event)
        self._left()


class Segments(pg.GraphicsObject):  # type: ignore[misc] # ships no types
    """Segments given by pairs of ends, so that one item draws all; the pens are as wide at any zoom."""

    def __init__(self, view: pg.ViewBox, colour: QColor, *, alpha: int = 255, width: int = 1, shadow: int = 0) -> None:
        """Add an item without segments to a view; `shadow` is the width of a dark line below each, px."""
        super().__init__()
        pen = pg.mkPen((colour.red(), colour.green(), colour.blue(), alpha), width=width)
        self._pens = (*([pg.mkPen((0, 0, 0, 200), width=shadow)] * bool(shadow)), pen)
        self.ends: Floats = np.zeros((0, 2))
        self._lines: Any = None
        self.setZValue(1)
        view.addItem(self, ignoreBounds=True)

    def draw(self, ends: Floats) -> None:
        """Show other segments (2 * segment, xy)."""
        if ends is not self.ends and not np.array_equal(ends, self.ends):
            self.ends, self._lines = ends, _sip.array(QLineF, len(ends) // 2)
            np.frombuffer(_sip.voidptr(self._lines, 16 * len(ends)), np.float64)[:] = ends.ravel()
            self.update()

    def paint(self, painter: QPainter, *_: object) -> None:
        for pen in self._pens if len(self.ends) else ():
            painter.setPen(pen)
            painter.drawLines(self._lines)

    def boundingRect(self) -> QRectF:  # noqa: N802 - Qt's name
        """Return where segments may lie; their true border costs a tenth of painting them."""
        return QRectF(-1e6, -1e6, 2e6, 2e6)


@lru_cache(maxsize=4)
def lattice_lines(lattice: Lattice, lenslet_rows: int, lenslet_columns: int) -> Floats:
    """Return the borders of all cells (2 * border, xy), px; a square lattice has each line once."""
    if lattice.arrangement == "hexagonal":
        middle = lenslet_centers(lattice.arrangement, lenslet_rows, lenslet_columns)[..., None, :]
        return lattice.camera_px((middle + lattice.cell_corners[_AROUND]).reshape(-1, 2))
    x = centered_steps(lenslet_columns + 1)
    y = centered_steps(lenslet_rows + 1)
    vertical = [[(along, y[0]), (along, y[-1])] for along in x]
    horizontal = [[(x[0], along), (x[-1], along)] for along in y]
    return lattice.camera_px(np.array(vertical + horizontal).reshape(-1, 2))


def lost_boxes(lattice: Lattice, is_lost: NDArray[np.bool_]) -> Floats:
    """Return a crossed box in the cell of every lost lenslet (lenslet_row, lenslet_column)."""
    if not is_lost.any():
        return np.zeros((0, 2))
    middle = lenslet_centers(lattice.arrangement, *is_lost.shape)[is_lost]
    box = lattice.cell_corners[[*_AROUND, 0, 2, 1, 3]] * _INSET
    return lattice.camera_px((middle[:, None] + box).reshape(-1, 2))


def cell_border(lattice: Lattice, lenslets: tuple[int, int], at: tuple[int, int]) -> Floats:
    """Return the border of the cell of one lenslet (row, column)."""
    middle = lenslet_centers(lattice.arrangement, *lenslets)[at]
    return lattice.camera_px(middle + lattice.cell_corners[_AROUND])


def arrows(lattice: Lattice, displacement_px: Floats, magnification: float) -> Floats:
    """Return an arrow along each displacement (lenslet_row, lenslet_column, xy), none where it is NaN or 0."""
    known = np.isfinite(displacement_px).all(axis=-1) & displacement_px.any(axis=-1)
    tail = lenslet_centers(lattice.arrangement, *known.shape)[known] @ lattice.pitch_matrix_px
    shaft = displacement_px[known] * magnification
    tip = tail + shaft
    barbs = tip + _HEAD * shaft @ _BARBS
    return lattice.to_camera_px(np.stack([tail, tip, tip, barbs[0], tip, barbs[1]], axis=1).reshape(-1, 2))


def arrow_length_px(displacement_px: Floats) -> float:
    """Return the length that few displacements (lenslet_row, lenslet_column, xy) exceed; NaN if none."""
    length_px = np.hypot(*displacement_px[np.isfinite(displacement_px).all(axis=-1)].T)
    length_px.sort()
    return float(length_px[math.ceil(_USUAL * (length_px.size - 1))]) if length_px.size else float("nan")


def lenslet_at(lattice: Lattice, shape: tuple[int, int], x_px: float, y_px: float) -> tuple[int, int] | None:
    """Return row and column of the lenslet whose cell holds a camera pixel, if any."""
    (column, row), _, is_inside = lattice.cells_at(np.array([x_px, y_px]), *shape)
    return (int(row), int(column)) if is_inside else None


class DrawingView(pg.ViewBox):  # type: ignore[misc] # pyqtgraph declares no types
    """A view in which a drag of the left button draws, if `is_drawing`, else moves the picture."""

    drawn = pyqtSignal(QPointF, QPointF, bool)  # from, to, and whether the button is released
    is_drawing = False

    def mouseDragEvent(self, event: Any, axis: int | None = None) -> None:  # noqa: N802 - pyqtgraph's name
        """Draw, or move the picture; the middle button always moves it."""
        if not self.is_drawing or event.button() != Qt.MouseButton.LeftButton:
            super().mouseDragEvent(event, axis)
            return
        event.accept()
        ends = (event.buttonDownScenePos(), event.scenePos())
        self.drawn.emit(*map(self.mapSceneToView, ends), event.isFinish())


def pupil_edges(lattice: Lattice | None, sensor: Sensor | None, pupil: Pupil | None) -> Floats:
    """Return the edges of a pupil and of its shadow as pairs of ends (2 * segment, xy)."""
    if lattice is None or sensor is None or pupil is None:
        return np.zeros((0, 2))
    return lattice.camera_px(pupil.edges_m / sensor.lenslet_pitch_m)


def rectangle(start: QPointF, end: QPointF) -> Floats:
    """Return the borders of a rectangle as pairs of ends (2 * border, xy)."""
    (left, right), (top, bottom) = (start.x(), end.x()), (start.y(), end.y())
    corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    return corners[_AROUND]
