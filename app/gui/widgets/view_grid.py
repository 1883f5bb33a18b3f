"""Grid of maps, one for each view, with captions and a colour bar."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from PyQt6.QtCore import QEvent, QPoint, QPointF, QRect, QRectF, QSize, Qt, pyqtSignal
from PyQt6.QtGui import QBrush, QColor, QHelpEvent, QImage, QKeyEvent, QMouseEvent, QPainter, QPaintEvent, QPen, QRegion
from PyQt6.QtWidgets import QToolTip, QWidget

from app.gui.widgets import theme
from app.gui.widgets.copies import as_table
from app.gui.widgets.presentation import ColourScale, colour_table, number
from app.results.pictures import Pixels, enlarged
from reconstruction.arrays import Floats

_GAP_PX = 3  # between views
_BAR_WIDTH_PX, _BAR_MARGIN_PX, _BAR_TICK_PX = 14, 10, 7  # colour bar, space left of it, space before its numbers
LEAST_LINES = 5  # height of a grid that has a colour bar: its title and the numbers at both ends fit
MARGIN_PX = 3  # around all views, for the selection frame
_BETWEEN_PX = 14  # between the captions of neighbours
_LEAST_PX = 40  # width of views with captions: of narrower ones only the tool tips have the numbers
_STEPS = {Qt.Key.Key_Left: (0, -1), Qt.Key.Key_Right: (0, 1), Qt.Key.Key_Up: (-1, 0), Qt.Key.Key_Down: (1, 0)}
_UNSURE = QBrush(QColor(0, 0, 0), Qt.BrushStyle.FDiagPattern)  # over values
_DIGIT = re.compile(r"\d")

Caption = tuple[tuple[str, ...], tuple[str, ...]]  # left and right part, each with its wordings, longest first


@dataclass(frozen=True, slots=True, eq=False)
class Maps:
    """A map for every view; NaN is hatched on grey, and an unsure value over its colour."""

    values: Floats  # (view_row, view_column, row, column)
    scale: ColourScale
    describe: Callable[[int, int, float], str]  # text for row, column and value of a pixel
    is_smooth: bool = False  # whether to interpolate: samples of a function, not lenslets
    reach: tuple[float, float] = (1.0, 1.0)  # x and y of the last column's and row's middle, about the map's middle
    reach_unit: str = ""
    unsure: NDArray[np.bool_] | None = None  # values with large errors
    sigma: Floats | None = None  # standard deviations of the values
    outline: Iterable[tuple[float, float]] = ()  # lines on the map: pairs of ends (x, y), shares of its size

    def only(self, row: int, column: int) -> Self:
        """Return the map of one view."""
        part = slice(row, row + 1), slice(column, column + 1)
        unsure = None if self.unsure is None else self.unsure[part]
        sigma = None if self.sigma is None else self.sigma[part]
        return replace(self, values=self.values[part], unsure=unsure, sigma=sigma)

    def text_at(self, view: tuple[int, int], row: int, column: int) -> str:
        """Describe a pixel of a view, with the error of its value if that is known."""
        value = float(self.values[view][row, column])
        sigma = math.nan if self.sigma is None or math.isnan(value) else float(self.sigma[view][row, column])
        text, _, unit = (described := self.describe(row, column, value)).rpartition(" ")
        return f"{text} \N{PLUS-MINUS SIGN} {number(sigma, 2)} {unit}" if math.isfinite(sigma) else described


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
        return QRect(self.first + QPoint(view_column * self.step.width(), view_row * self.step.height()), self.size)


@lru_cache
def arrange_views(
    room: tuple[int, int], shape: tuple[int, ...], *, bar_space: int, line_px: int, is_captioned: bool
) -> Places:
    """Arrange maps of a shape (view_row, view_column, row, column) in an area, above captions that fit."""
    captioned = _arrange(QSize(*room), shape, bar_space, line_px + 1) if is_captioned else None
    if captioned is not None and captioned.size.width() >= _LEAST_PX:
        return captioned
    return _arrange(QSize(*room), shape, bar_space, 0)


def _arrange(room: QSize, shape: tuple[int, ...], bar_space: int, below: int) -> Places:
    view_rows, view_columns, rows, columns = shape
    if not min(shape):
        return Places(QPoint(), QSize(0, 0), QSize(), 0, has_captions=False, tiles=QRegion())
    width = (room.width() - 2 * MARGIN_PX - bar_space - (view_columns - 1) * _GAP_PX) / view_columns
    height = (room.height() - 2 * MARGIN_PX - (view_rows - 1) * _GAP_PX) / view_rows - below
    scale = max(min(width / columns, height / rows), 0)
    size = QSize(int(scale * columns), int(scale * rows))
    step = QSize(size.width() + _GAP_PX, size.height() + below + _GAP_PX)
    used = QSize(view_columns * step.width() - _GAP_PX + bar_space, view_rows * step.height() - _GAP_PX)
    left, top = (room.width() - used.width()) // 2, (room.height() - used.height()) // 2
    first = QPoint(max(left, MARGIN_PX), max(top, MARGIN_PX))
    tiles = QRegion()
    for row, column in np.ndindex(view_rows, view_columns):
        tiles += QRect(first + QPoint(column * step.width(), row * step.height()), size)
    return Places(first, size, step, bar_space, has_captions=bool(below), tiles=tiles)


class ViewGrid(QWidget):
    """Paints the maps as the views lie in the field and frames the selected view."""

    selected = pyqtSignal(int, int)  # view row and column
    opened = pyqtSignal()  # the selected view, by a double click
    bar_clicked = pyqtSignal(QRect)  # at this place

    def __init__(
        self,
        least: tuple[int, int] = (260, 160),
        empty: str = "No wavefront",
        parent: QWidget | None = None,
        *,
        widest: str = "",
        is_captioned: bool = True,
    ) -> None:
        """Take at least this width and height, px; show `empty` without maps, and space for the `widest` number."""
        super().__init__(parent)
        self._is_captioned = is_captioned
        self.has_bar: bool | None = None  # None: if there is space
        self.is_hatched = True  # whether unknown pixels are hatched, or only grey
        self.maps: Maps | None = None
        self.empty = empty
        self._pixels: Pixels = np.zeros((0, 0, 0, 0), np.uint32)
        self._shown_scale: ColourScale | None = None
        self._least_number = self._number_width = self.fontMetrics().horizontalAdvance(widest)  # px
        self._painted: Places | None = None
        self.is_stale = False  # whether the maps are grey, since dark or reference no longer fit
        self.captions: Mapping[tuple[int, int], Caption] = {}  # by view_row and view_column
        self.selection: tuple[int, int] | None = None  # the framed view
        self.setMinimumSize(*least)
        self.setAccessibleName("Map of each view")
        self.setAutoFillBackground(True)  # else all that lies below is painted, too
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)

    def show_maps(self, maps: Maps | None) -> None:
        self.maps = maps
        scale = None if maps is None else self.scale_of(maps)
        before, self._shown_scale = self._shown_scale, scale
        if maps is not None and scale is not None:
            self._pixels = scale.pixels(maps.values)
            if self.is_stale:
                self._pixels = _faded(self._pixels, self.palette().window().color())
            if scale == before and self.places is self._painted:
                self.update(self.places.tiles)  # captions and colour bar are as before, and cost as much as the maps
                return
            is_same = before is not None and before.title == scale.title
            before_px = self._number_width if is_same else self._least_number
            widths = [self.fontMetrics().horizontalAdvance(text) for _, text in maps.scale.ticks]
            self._number_width = max(before_px, max(widths) + 1)  # shrinks only with another unit: the maps stay
        self.update()

    def show_stale(self, *, is_stale: bool) -> None:
        if is_stale != self.is_stale:
            self.is_stale = is_stale
            self.show_maps(self.maps)

    def select(self, view: tuple[int, int] | None) -> None:
        """Frame the view (view_row, view_column), or none."""
        if view != self.selection:
            self.selection = view
            self.update()

    def set_captions(self, captions: Mapping[tuple[int, int], Caption]) -> None:
        """Show captions by (view_row, view_column), in the longest wording that fits."""
        if captions != self.captions:
            self.captions = captions
            self.update(QRegion(self.rect()).subtracted(self.places.tiles))

    def paintEvent(self, event: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        painter = QPainter(self)
        maps = self.maps
        if maps is None:
            painter.setPen(theme.DIM)
            painter.drawText(self.rect(), Qt.AlignmentFlag.AlignCenter, self.empty)
            return
        places, painted = self.places, QRegion(self.rect()) if event is None else event.region()
        self._painted = places
        is_only_maps = painted.subtracted(places.tiles).isEmpty()
        if not is_only_maps:
            painter.setPen(theme.LINE)  # around the maps: white and black may be the background
            for view in np.ndindex(maps.values.shape[:2]):
                painter.drawRect(places.tile(*view).adjusted(-1, -1, 0, 0))
        if painted.intersects(places.tiles):
            self._paint_maps(painter, maps)
        if self.selection is not None:
            painter.setPen(QPen(theme.ACCENT, 2))
            painter.setBrush(Qt.BrushStyle.NoBrush)
            painter.drawRect(places.tile(*self.selection).adjusted(-1, -1, 1, 1))
        if is_only_maps:
            return
        if places.has_captions:
            self._paint_captions(painter)
        if places.bar_space:
            self._paint_color_bar(painter, maps)

    def event(self, event: QEvent | None) -> bool:
        if isinstance(event, QHelpEvent) and event.type() == QEvent.Type.ToolTip:
            QToolTip.showText(event.globalPos(), self._value_at(event.pos()), self)
            return True
        return super().event(event)

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        if event is None or event.button() != Qt.MouseButton.LeftButton or self.maps is None:
            return
        if (view := self._view_at(event.pos())) is not None:
            self.selected.emit(*view)
        elif self.places.bar_space and event.pos().x() >= (bar := self._bar(self.maps)).left():
            self.bar_clicked.emit(bar)

    def mouseDoubleClickEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        if event is not None and self._view_at(event.pos()) is not None:
            self.opened.emit()

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802 - Qt's name
        step = None if event is None else _STEPS.get(Qt.Key(event.key()))
        if step is None or self.maps is None:
            super().keyPressEvent(event)
        else:
            self._step(self.maps, *step)

    def _step(self, maps: Maps, down: int, right: int) -> None:
        """Select the next view in a direction."""
        if self.selection is not None:
            row, column = self.selection[0] + down, self.selection[1] + right
            if 0 <= row < maps.values.shape[0] and 0 <= column < maps.values.shape[1]:
                self.selected.emit(row, column)

    def scale_of(self, maps: Maps) -> ColourScale:
        """From black to white while the maps are stale: a sign stays visible."""
        return replace(maps.scale, colours="CET-L1") if self.is_stale else maps.scale

    def _view_at(self, position: QPoint) -> tuple[int, int] | None:
        if self.maps is None:
            return None
        views = np.ndindex(self.maps.values.shape[:2])
        return next(((row, column) for row, column in views if self.places.tile(row, column).contains(position)), None)

    def _value_at(self, position: QPoint) -> str:
        view = self._view_at(position)
        if self.maps is None or view is None:
            return ""
        tile, values = self.places.tile(*view), self.maps.values[view]
        inside = position - tile.topLeft()
        row = inside.y() * values.shape[0] // tile.height()
        column = inside.x() * values.shape[1] // tile.width()
        text = self.maps.text_at(view, row, column)
        return "\n".join([text, *(wordings[0] for wordings in self.captions.get(view, ()))])

    def table(self) -> str:
        """Return all maps as lines of tab-separated numbers, one for each pixel."""
        if self.maps is None:
            return ""
        at = np.indices(self.maps.values.shape).reshape(4, -1)
        unit = self.maps.scale.title.split()[0]
        heads = ["view row", "view column", "row", "column", f"value ({unit})", f"standard deviation ({unit})"]
        values = [each.ravel() for each in (self.maps.values, self.maps.sigma) if each is not None]
        return as_table(heads[: 4 + len(values)], np.vstack([at, *values]).T)

    @property
    def places(self) -> Places:
        shape = (0, 0, 0, 0) if self.maps is None else self.maps.values.shape
        line, has_bar = self.fontMetrics().height(), self.has_bar
        if has_bar is None:
            has_bar = self.width() >= 2 * self.bar_space + line and self.height() >= LEAST_LINES * line
        room, space = (self.width(), self.height()), self.bar_space * has_bar
        return arrange_views(room, shape, bar_space=space, line_px=line, is_captioned=self._is_captioned)

    @property
    def bar_space(self) -> int:
        """Width of a colour bar with its numbers, px."""
        return _BAR_MARGIN_PX + _BAR_WIDTH_PX + _BAR_TICK_PX + self._number_width

    def _paint_maps(self, painter: QPainter, maps: Maps) -> None:
        """Paint all maps; unknown pixels, which are transparent, are hatched.

        Each is clipped to a rectangle: all else Qt fills in threads of its own, and keeps Python's lock until they end.
        """
        places, is_known = self.places, bool(self._pixels.all())
        if not is_known:
            for row, column in np.argwhere(~self._pixels.all(axis=(2, 3))):
                painter.fillRect(places.tile(row, column), theme.RAISED)
                if self.is_hatched:
                    painter.fillRect(places.tile(row, column), QBrush(theme.LINE, Qt.BrushStyle.BDiagPattern))
        ratio = self.devicePixelRatioF()
        width, height = math.ceil(places.size.width() * ratio), math.ceil(places.size.height() * ratio)
        shown = enlarged(self._pixels, height, width, is_smooth=maps.is_smooth and is_known)
        image = _image(shown.reshape(-1, width))  # one below the other; it refers to their memory
        for index, view in enumerate(np.ndindex(shown.shape[:2])):
            painter.setClipRect(places.tile(*view))
            painter.drawImage(QRectF(places.tile(*view)), image, QRectF(0, index * height, width, height))
            if maps.unsure is not None:
                self._paint_unsure(painter, places.tile(*view), maps.unsure[view])
            corner = places.tile(*view).topLeft().toPointF()
            if lines := [corner + QPointF(x * width / ratio, y * height / ratio) for x, y in maps.outline]:
                painter.setPen(QPen(theme.GREEN_ON_IMAGE, 1))
                painter.drawLines(*lines)
        painter.setClipping(False)

    def _paint_unsure(self, painter: QPainter, tile: QRect, unsure: NDArray[np.bool_]) -> None:
        if unsure.all():
            painter.fillRect(tile, _UNSURE)
            return
        height, width = tile.height() / unsure.shape[0], tile.width() / unsure.shape[1]
        for row, column in np.argwhere(unsure):
            place = QRectF(tile.left() + column * width, tile.top() + row * height, width, height)
            painter.fillRect(place.toRect(), _UNSURE)

    def _paint_captions(self, painter: QPainter) -> None:
        """Write the number at the left, and the place at the right if there is space for both."""
        line, width = self.fontMetrics().height(), self.places.size.width()
        number, numbers_px = self._wording(0, width)
        place, _ = self._wording(1, width - numbers_px - _BETWEEN_PX)
        for (row, column), (numbers, places) in self.captions.items():
            tile = self.places.tile(row, column)
            below = QRect(tile.left(), tile.bottom() + 2, width, line)
            if number is not None:
                painter.setPen(theme.DIM if self.is_stale else theme.TEXT)
                painter.drawText(below, Qt.AlignmentFlag.AlignLeft, numbers[number])
            if place is not None:
                painter.setPen(theme.DIM)
                painter.drawText(below, Qt.AlignmentFlag.AlignRight, places[place])

    def _wording(self, side: int, room_px: int) -> tuple[int | None, int]:
        """Return the longest wording of a side that fits under all views, if any, and its width."""
        # Measuring takes longer than painting all maps; digits are equally wide, and most texts differ only in them.
        by_wording = zip(*(sides[side] for sides in self.captions.values()), strict=True)
        for index, texts in enumerate(by_wording):
            widest = max(map(self.fontMetrics().horizontalAdvance, {_DIGIT.sub("0", text) for text in texts}))
            if widest <= room_px:
                return index, widest
        return None, 0

    def _paint_color_bar(self, painter: QPainter, maps: Maps) -> None:
        line, bar = self.fontMetrics().height(), self._bar(maps)
        painter.setOpacity(0.5 if self.is_stale else 1.0)
        painter.drawImage(bar.topLeft(), _colour_bar(self.scale_of(maps).colours, bar.width(), bar.height()))
        painter.setOpacity(1.0)
        painter.setPen(theme.TEXT)
        title = QRect(bar.left(), bar.top() - line - 4, self.width(), line)
        painter.drawText(title, Qt.AlignmentFlag.AlignVCenter, maps.scale.title)
        for fraction, text in self._ticks(maps.scale, bar):
            y = bar.top() + round((1 - fraction) * (bar.height() - 1))
            text_y = min(max(y - line // 2, bar.top() - 2), bar.bottom() + 2 - line)
            painter.drawLine(bar.right() + 1, y, bar.right() + 4, y)
            place = QRect(bar.right() + _BAR_TICK_PX, text_y, self._number_width, line)
            painter.drawText(place, Qt.AlignmentFlag.AlignVCenter, text)

    def _bar(self, maps: Maps) -> QRect:
        """Return the place of the colour bar, below its title."""
        view_rows, view_columns = maps.values.shape[:2]
        top, bottom = self.places.tile(0, view_columns - 1), self.places.tile(view_rows - 1, view_columns - 1)
        first = top.top() + self.fontMetrics().height() + 4
        return QRect(top.right() + _BAR_MARGIN_PX, first, _BAR_WIDTH_PX, bottom.bottom() - first + 1)

    def _ticks(self, scale: ColourScale, bar: QRect) -> tuple[tuple[float, str], ...]:
        """Return all numbers, both ends with the middle, or the ends only, as fit next to the bar."""
        ticks, most = tuple(scale.ticks), bar.height() // self.fontMetrics().height()
        if len(ticks) > most:
            ticks = ticks[:: max((len(ticks) - 1) // 2, 1)]
        return ticks[:: len(ticks) - 1] if len(ticks) > most else ticks


@lru_cache
def _colour_bar(colours: str, width: int, height: int) -> QImage:
    """Return the bar without its numbers; scaling it in every frame took longer than all maps."""
    table = colour_table(colours)
    at = np.linspace(len(table) - 1, 0, height).round().astype(np.intp)
    return _image(np.repeat(table[at, None], width, axis=1)).copy()


def _faded(pixels: Pixels, background: QColor) -> Pixels:
    """Return colours (...) halfway to the background; transparent ones, which are hatched, stay so."""
    halves = [colours >> 1 & np.uint32(0x7F7F7F) for colours in (pixels, np.uint32(background.rgb()))]
    return np.where(pixels, np.uint32(0xFF000000) | (halves[0] + halves[1]), np.uint32(0))


def _image(pixels: Pixels) -> QImage:
    """Return an image that refers to the memory of pixels (row, column)."""
    rows, columns = pixels.shape
    memory: Any = pixels.data
    return QImage(memory, columns, rows, 4 * columns, QImage.Format.Format_ARGB32_Premultiplied)
