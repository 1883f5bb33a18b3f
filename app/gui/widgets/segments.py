"""Line segments over the camera image, in camera pixels: cells, lost lenslets, arrows.

They are drawn as they are: a curve of pyqtgraph makes a path of them first. Each function returns pairs of rows
(end, xy), so that one item draws all its segments.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PyQt6 import sip
from PyQt6.QtCore import QLineF, QRectF
from PyQt6.QtGui import QColor, QPainter, QPainterPath, QPen

from reconstruction.arrays import Floats
from reconstruction.geometry import Lattice, centered_steps, lenslet_centers

_ANYWHERE = QRectF(-1e6, -1e6, 2e6, 2e6)  # px
_SHADOW = QColor(0, 0, 0, 200)
_AROUND = [0, 1, 1, 2, 2, 3, 3, 0]  # corners at the ends of a cell's four borders
_INSET = 0.88  # size of a lost lenslet's box over that of its cell
_USUAL = 0.98  # share of the arrows that are not the longest few
_HEAD = 0.35  # length of an arrow's head, in arrow lengths
_BARBS = np.array([[[-0.9, 0.45], [-0.45, -0.9]], [[-0.9, -0.45], [0.45, -0.9]]])  # turn and shorten the shaft


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


@lru_cache(maxsize=4)
def lattice_lines(lattice: Lattice, lenslet_rows: int, lenslet_columns: int) -> Floats:
    """Return the borders of all cells; a square lattice has each line once."""
    if lattice.arrangement == "hexagonal":
        middle = lenslet_centers(lattice.arrangement, lenslet_rows, lenslet_columns)[..., None, :]
        return lattice.to_camera_px((middle + lattice.cell_corners[_AROUND]).reshape(-1, 2) * lattice.pitch_px)
    x = centered_steps(lenslet_columns + 1)
    y = centered_steps(lenslet_rows + 1)
    vertical = [[(along, y[0]), (along, y[-1])] for along in x]
    horizontal = [[(x[0], along), (x[-1], along)] for along in y]
    return lattice.to_camera_px(np.array(vertical + horizontal).reshape(-1, 2) * lattice.pitch_px)


def lost_boxes(lattice: Lattice, is_lost: NDArray[np.bool_]) -> Floats:
    """Return a crossed box in the cell of every lost lenslet (lenslet_row, lenslet_column)."""
    if not is_lost.any():
        return np.zeros((0, 2))
    middle = lenslet_centers(lattice.arrangement, *is_lost.shape)[is_lost]
    box = lattice.cell_corners[[*_AROUND, 0, 2, 1, 3]] * _INSET
    return lattice.to_camera_px((middle[:, None] + box).reshape(-1, 2) * lattice.pitch_px)


def cell_border(lattice: Lattice, lenslets: tuple[int, int], at: tuple[int, int]) -> Floats:
    """Return the border of the cell of one lenslet (row, column)."""
    middle = lenslet_centers(lattice.arrangement, *lenslets)[at]
    return lattice.to_camera_px((middle + lattice.cell_corners[_AROUND]) * lattice.pitch_px)


def arrows(lattice: Lattice, displacement_px: Floats, magnification: float) -> Floats:
    """Return an arrow from every lenslet's centre along its displacement (lenslet_row, lenslet_column, xy), px.

    Lenslets without a displacement (NaN), or with one of 0, have no arrow.
    """
    known = np.isfinite(displacement_px).all(axis=-1) & displacement_px.any(axis=-1)
    tail = _middles(lattice, *displacement_px.shape[:2])[known]
    shaft = displacement_px[known] * magnification
    tip = tail + shaft
    barbs = tip + _HEAD * shaft @ _BARBS
    return lattice.to_camera_px(np.stack([tail, tip, tip, barbs[0], tip, barbs[1]], axis=1).reshape(-1, 2))


@lru_cache(maxsize=4)
def _middles(lattice: Lattice, lenslet_rows: int, lenslet_columns: int) -> Floats:
    """Return the lenslets' centres (lenslet_row, lenslet_column, xy) along the lattice, px."""
    return lenslet_centers(lattice.arrangement, lenslet_rows, lenslet_columns) * lattice.pitch_px


def arrow_length_px(displacement_px: Floats) -> float:
    """Return the length of all but the longest few displacements (lenslet_row, lenslet_column, xy); NaN if none."""
    length_px = np.hypot(*displacement_px[np.isfinite(displacement_px).all(axis=-1)].T)
    length_px.sort()
    return float(length_px[math.ceil(_USUAL * (length_px.size - 1))]) if length_px.size else float("nan")


def lenslet_at(lattice: Lattice, shape: tuple[int, int], x_px: float, y_px: float) -> tuple[int, int] | None:
    """Return row and column of the lenslet whose cell holds a camera pixel, if any."""
    (column, row), _, is_inside = lattice.cells_at(np.array([x_px, y_px]), *shape)
    return (int(row), int(column)) if is_inside else None
