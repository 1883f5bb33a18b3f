"""Places of the views in a grid of maps."""

from dataclasses import dataclass

import numpy as np
from PyQt6.QtCore import QPoint, QRect, QSize
from PyQt6.QtGui import QRegion

_CAPTION = 100  # px: small views stand apart, if there is room, so that their captions fit
_MARGIN = 3  # px around all views, for the selection frame


@dataclass(frozen=True, slots=True)
class Places:
    """Places of the views in the widget."""

    first: QPoint  # corner of the first view
    size: QSize  # of each
    step: QSize  # from one to the next
    bar_space: int  # width of the colour bar and its numbers; 0 if the views need it: tool tips have the values
    has_captions: bool
    tiles: QRegion  # of all views

    def tile(self, view_row: int, view_column: int) -> QRect:
        """Return the rectangle of a view without its caption."""
        return QRect(self.first + QPoint(view_column * self.step.width(), view_row * self.step.height()), self.size)


def arrange_views(room: QSize, shape: tuple[int, ...], *, bar_space: int, below: int, gap: int) -> Places:
    """Arrange maps (view_row, view_column, row, column) in a room, with so many pixels below and between them."""
    view_rows, view_columns, rows, columns = shape
    if not min(shape):
        return Places(QPoint(), QSize(), QSize(), 0, has_captions=False, tiles=QRegion())
    width = (room.width() - 2 * _MARGIN - bar_space - (view_columns - 1) * gap) / view_columns
    height = (room.height() - 2 * _MARGIN - (view_rows - 1) * gap) / view_rows - below
    scale = max(min(width / columns, height / rows), 0)
    size = QSize(int(scale * columns), int(scale * rows))
    free = room.width() - 2 * _MARGIN - bar_space - view_columns * size.width() - (view_columns - 1) * gap
    wider = min(max(_CAPTION - size.width() - gap, 0), max(free, 0) // max(view_columns - 1, 1)) if below else 0
    step = QSize(size.width() + gap + wider, size.height() + below + gap)
    used = QSize(view_columns * step.width() - gap - wider + bar_space, view_rows * step.height() - gap)
    left, top = (room.width() - used.width()) // 2, (room.height() - used.height()) // 2
    first = QPoint(max(left, _MARGIN), max(top, _MARGIN))
    tiles = QRegion()
    for row, column in np.ndindex(view_rows, view_columns):
        tiles += QRect(first + QPoint(column * step.width(), row * step.height()), size)
    return Places(first, size, step, bar_space, has_captions=bool(below), tiles=tiles)
