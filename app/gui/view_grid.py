"""The painted grid of views with its colour bar."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyqtgraph as pg
from PyQt6.QtCore import QEvent, QPoint, QRect, QSize, Qt
from PyQt6.QtGui import QHelpEvent, QImage, QPainter, QPaintEvent
from PyQt6.QtWidgets import QToolTip, QWidget

from app.gui import theme
from reconstruction.geometry import Floats

_GAP = 10
_BAR_WIDTH, _BAR_MARGIN, _BAR_TICK = 14, 16, 7  # px: colour bar, what is left of it, and right of it up to its numbers
_BAR_FRACTIONS = (1.0, 0.5, 0.0, -0.5, -1.0)  # of the limit: where it has numbers
_SMALLEST_CAPTIONED = 48  # px: narrower views have no room for a number; their tool tips tell it
_COLOURS: np.ndarray[tuple[int, int], np.dtype[np.uint8]] = pg.colormap.get("CET-D1").getLookupTable(nPts=255)
_ARGB = np.uint32(0xFF000000) | (_COLOURS.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32))


class ViewGrid(QWidget):
    """Paints every view as a map of its lenslets; a lenslet of which nothing is known is hatched."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._views: Floats | None = None
        self._limit_rad = 1.0
        self._number_width = 0  # px
        self._captions: Mapping[tuple[int, int], tuple[str, str]] = {}
        self.setMinimumSize(260, 220)

    @property
    def limit_rad(self) -> float:
        """Where the colour scale ends on either side of zero."""
        return self._limit_rad

    @property
    def captions(self) -> Mapping[tuple[int, int], tuple[str, str]]:
        """The two lines under each view (view_row, view_column)."""
        return self._captions

    def show_views(self, views: Floats, limit_rad: float) -> None:
        """Show wavefronts (view_row, view_column, lenslet_row, lenslet_column), rad, on the scale -limit ... +limit."""
        self._views, self._limit_rad = views, limit_rad
        numbers = (_signed(fraction * limit_rad) for fraction in _BAR_FRACTIONS)
        self._number_width = max(self.fontMetrics().horizontalAdvance(number) for number in numbers) + 1
        self.update()

    def show_nothing(self) -> None:
        """Show that there is no wavefront now."""
        self._views = None
        self.update()

    def set_captions(self, captions: Mapping[tuple[int, int], tuple[str, str]]) -> None:
        """Write two lines under each view (view_row, view_column)."""
        if captions != self._captions:
            self._captions = captions
            self.update()

    def tile(self, view_row: int, view_column: int) -> QRect:
        """Where a view is painted, without its caption."""
        first, size, step = self._layout()
        return QRect(first + QPoint(view_column * step.width(), view_row * step.height()), size)

    def paintEvent(self, _: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        """Paint all views."""
        painter = QPainter(self)
        if self._views is None:
            painter.setPen(theme.DIM)
            painter.drawText(self.rect(), Qt.AlignmentFlag.AlignCenter, "no wavefront")
            return
        pixels = _argb(self._views, self._limit_rad)
        hatching = theme.hatching()
        for row, column in np.ndindex(self._views.shape[:2]):
            tile, view = self.tile(row, column), pixels[row, column]
            if not view.all():  # something is transparent
                painter.fillRect(tile, theme.RAISED)
                painter.fillRect(tile, hatching)
            image = QImage(view.tobytes(), view.shape[1], view.shape[0], 4 * view.shape[1], QImage.Format.Format_ARGB32)
            painter.drawImage(tile, image)
        if self._has_captions():
            self._paint_captions(painter)
        self._paint_color_bar(painter)

    def event(self, event: QEvent | None) -> bool:
        """Say what lies under the pointer when it rests."""
        if isinstance(event, QHelpEvent) and event.type() == QEvent.Type.ToolTip:
            QToolTip.showText(event.globalPos(), self._value_at(event.pos()), self)
            return True
        return super().event(event)

    def _value_at(self, position: QPoint) -> str:
        if self._views is None:
            return ""
        for row, column in np.ndindex(self._views.shape[:2]):
            tile, view = self.tile(row, column), self._views[row, column]
            if tile.contains(position):
                inside = position - tile.topLeft()
                lenslet_row = inside.y() * view.shape[0] // tile.height()
                lenslet_column = inside.x() * view.shape[1] // tile.width()
                value = view[lenslet_row, lenslet_column]
                text = f"{value:+.2f} rad" if np.isfinite(value) else "nothing is known here: the lenslet is lost"
                caption = "\n".join(self._captions.get((row, column), ()))
                return f"Lenslet row {lenslet_row}, column {lenslet_column}: {text}\n{caption}".strip()
        return "Phase in rad, piston removed. Hatched: nothing is known there."

    def _has_captions(self) -> bool:
        return self._layout(captions=True)[1].width() >= _SMALLEST_CAPTIONED

    def _layout(self, *, captions: bool | None = None) -> tuple[QPoint, QSize, QSize]:
        """Return the first view's corner, the size of each, and the step from one to the next."""
        if self._views is None:
            return QPoint(), QSize(), QSize()
        view_rows, view_columns, lenslet_rows, lenslet_columns = self._views.shape
        has_captions = self._has_captions() if captions is None else captions
        bar_space = _BAR_MARGIN + _BAR_WIDTH + _BAR_TICK + self._number_width
        below = 2 * self.fontMetrics().height() + 4 if has_captions else 0
        gap = _GAP if has_captions else 3
        width = (self.width() - bar_space - (view_columns - 1) * gap) / view_columns
        height = (self.height() - (view_rows - 1) * gap) / view_rows - below
        scale = max(min(width / lenslet_columns, height / lenslet_rows), 0)
        size = QSize(int(scale * lenslet_columns), int(scale * lenslet_rows))
        step = QSize(size.width() + gap, size.height() + below + gap)
        used = QSize(view_columns * step.width() - gap + bar_space, view_rows * step.height() - gap)
        first = QPoint(max(self.width() - used.width(), 0) // 2, max(self.height() - used.height(), 0) // 2)
        return first, size, step

    def _paint_captions(self, painter: QPainter) -> None:
        line = self.fontMetrics().height()
        for (row, column), texts in self._captions.items():
            tile = self.tile(row, column)
            for index, (text, colour) in enumerate(zip(texts, (theme.TEXT, theme.DIM), strict=True)):
                painter.setPen(colour)
                place = QRect(tile.left(), tile.bottom() + 3 + index * line, tile.width(), line)
                fitting = self.fontMetrics().elidedText(text, Qt.TextElideMode.ElideRight, tile.width())
                painter.drawText(place, Qt.AlignmentFlag.AlignHCenter | Qt.AlignmentFlag.AlignVCenter, fitting)

    def _paint_color_bar(self, painter: QPainter) -> None:
        if self._views is None:
            return
        top = self.tile(0, self._views.shape[1] - 1)
        bottom = self.tile(self._views.shape[0] - 1, self._views.shape[1] - 1)
        line = self.fontMetrics().height()
        bar = QRect(top.right() + _BAR_MARGIN, top.top() + line + 4, _BAR_WIDTH, bottom.bottom() - top.top() - line - 3)
        ramp = np.ascontiguousarray(_ARGB[::-1, None])
        painter.drawImage(bar, QImage(ramp.tobytes(), 1, len(ramp), 4, QImage.Format.Format_ARGB32))
        painter.setPen(theme.TEXT)
        painter.drawText(QRect(bar.left(), top.top(), self.width(), line), Qt.AlignmentFlag.AlignVCenter, "rad")
        for fraction in _BAR_FRACTIONS:
            y = bar.top() + round((1 - fraction) / 2 * (bar.height() - 1))
            text_y = min(max(y - line // 2, bar.top() - 2), bar.bottom() + 2 - line)
            painter.drawLine(bar.right() + 1, y, bar.right() + 4, y)
            place = QRect(bar.right() + _BAR_TICK, text_y, self._number_width, line)
            painter.drawText(place, Qt.AlignmentFlag.AlignVCenter, _signed(fraction * self._limit_rad))


def _signed(value_rad: float) -> str:
    return f"{value_rad:+g}".replace("-", "\N{MINUS SIGN}") if value_rad else "0"


def _argb(views: Floats, limit_rad: float) -> np.ndarray[tuple[int, ...], np.dtype[np.uint32]]:
    """Colour wavefronts (..., lenslet_row, lenslet_column); what is NaN stays transparent."""
    known = np.isfinite(views)
    fraction = np.clip(np.where(known, views, 0) / limit_rad, -1, 1)
    index = np.rint((fraction + 1) / 2 * (len(_ARGB) - 1)).astype(np.intp)
    return np.where(known, _ARGB[index], np.uint32(0))
