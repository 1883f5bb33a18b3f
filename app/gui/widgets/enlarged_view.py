"""The selected view enlarged: map with contours and cursor, and two cross-sections."""

import numpy as np
from PyQt6.QtCore import QPointF, QSize, Qt, pyqtSignal
from PyQt6.QtGui import QColor, QMouseEvent, QPainter, QPaintEvent, QPen, QPolygonF, QShowEvent
from PyQt6.QtWidgets import QDialog, QWidget

from app.gui.widgets import theme
from app.gui.widgets.buttons import Button
from app.gui.widgets.copies import copy_picture
from app.gui.widgets.layouts import column, fill_dialog, row, within_screen
from app.gui.widgets.plot import Plot
from app.gui.widgets.presentation import number
from app.gui.widgets.texts import ElidedLabel
from app.gui.widgets.view_grid import Maps, ViewGrid
from app.results.pictures import contour_step, contours
from reconstruction.arrays import Floats

CONTOUR = _CURSOR = QColor(0, 0, 0)  # on the map, in every theme


class EnlargedMap(ViewGrid):
    """One map with contours and a cursor."""

    moved = pyqtSignal()

    def __init__(self) -> None:
        super().__init__((300, 260))
        self.cursor_at: tuple[int, int] | None = None  # row and column; None: the middle

    @property
    def values(self) -> Floats:
        """The map, (row, column)."""
        return np.zeros((0, 0)) if self.maps is None else self.maps.values[0, 0]

    @property
    def at(self) -> tuple[int, int]:
        """Row and column under the cursor."""
        rows, columns = self.values.shape
        row, column = (rows // 2, columns // 2) if self.cursor_at is None else self.cursor_at
        return min(row, rows - 1), min(column, columns - 1)

    def paintEvent(self, event: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        super().paintEvent(event)
        if self.maps is None:
            return
        tile, (rows, columns) = self.places.tile(0, 0), self.values.shape
        painter = QPainter(self)
        painter.setClipRect(tile)
        painter.translate(tile.topLeft().toPointF())
        step_x, step_y = tile.width() / columns, tile.height() / rows
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setPen(QPen(CONTOUR, 1))
        for line in contours(self.values, self.maps.scale.high):
            painter.drawPolyline(QPolygonF([QPointF((x + 0.5) * step_x, (y + 0.5) * step_y) for x, y in line]))
        painter.setRenderHint(QPainter.RenderHint.Antialiasing, on=False)
        at_row, at_column = self.at
        x, y = round((at_column + 0.5) * step_x), round((at_row + 0.5) * step_y)
        painter.setPen(QPen(_CURSOR, 1, Qt.PenStyle.DashLine))
        painter.drawLine(x, 0, x, tile.height())
        painter.drawLine(0, y, tile.width(), y)

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        if event is not None and event.button() == Qt.MouseButton.LeftButton:
            self.mouseMoveEvent(event)

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        tile, (rows, columns) = self.places.tile(0, 0), self.values.shape
        if event is not None and self.maps is not None and tile.isValid():
            inside = event.pos() - tile.topLeft()
            self._set_cursor(inside.y() * rows // tile.height(), inside.x() * columns // tile.width())

    def _step(self, _: Maps, down: int, right: int) -> None:
        self._set_cursor(self.at[0] + down, self.at[1] + right)

    def _set_cursor(self, row: int, column: int) -> None:
        rows, columns = self.values.shape
        self.cursor_at = min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)
        self.update()
        self.moved.emit()


class EnlargedView(QDialog):
    """Follows the selected view of a grid, in a window of its own."""

    def __init__(self, grid: ViewGrid, parent: QWidget) -> None:
        super().__init__(parent)
        self.setObjectName("enlarged")
        self.setWindowTitle("Enlarged view")
        self.setWindowFlag(Qt.WindowType.WindowMaximizeButtonHint)
        self._grid = grid
        self.map = EnlargedMap()
        self.map.moved.connect(self._show_sections)
        self.across = Plot("Along x", "x", widest="\N{MINUS SIGN}0.00")
        self.down = Plot("Along y", "y", widest="\N{MINUS SIGN}0.00")
        self._curves = [plot.add_curve(theme.ACCENT) for plot in (self.across, self.down)]
        self.text = ElidedLabel()
        self.copy = Button("Copy", "Copy the picture", lambda: copy_picture(self))
        sections = column((self.across, 1), (self.down, 1), spacing=12)
        parts = row((self.map, 5), (sections, 3), spacing=12)
        fill_dialog(self, row((self.text, 1), self.copy), (parts, 1))
        self.resize(within_screen(parent, QSize(860, 480)))
        self.refresh()

    def refresh(self) -> None:
        """Show the selected view of the grid as it is now."""
        if not self.isVisible() and self.map.maps is not None:
            return
        maps, view = self._grid.maps, self._grid.selection
        one: Maps | None = None
        if maps is not None and maps.values.size:
            rows, columns = maps.values.shape[:2]
            i, j = view if view is not None and view[0] < rows and view[1] < columns else (rows // 2, columns // 2)
            one = maps.only(i, j)
            self.map.set_captions({(0, 0): self._grid.captions[i, j]} if (i, j) in self._grid.captions else {})
        self.map.is_stale = self._grid.is_stale
        for plot in (self.across, self.down):
            plot.show_stale(is_stale=self._grid.is_stale)
        self.map.show_maps(one)
        self._show_sections()

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802 - Qt's name
        super().showEvent(event)
        self.refresh()

    def _show_sections(self) -> None:
        maps, values = self.map.maps, self.map.values
        if maps is None:
            for curve in self._curves:
                curve.setData([], [])
            self.text.setText(self._grid.empty)
            return
        (row_at, column_at), unit = self.map.at, maps.reach_unit
        x, y = (np.linspace(-reach, reach, count) for reach, count in zip(maps.reach, values.shape[::-1], strict=True))
        low, high = maps.scale.low, maps.scale.high
        for plot, curve, along, section, axis in (
            (self.across, self._curves[0], x, values[row_at], "x"),
            (self.down, self._curves[1], y, values[:, column_at], "y"),
        ):
            curve.setData(along, section, connect="finite")
            half = max(float(along[-1]), 1e-9)
            plot.set_ranges((-half, half), (low, high))
            plot.axes["bottom"].setLabel(f"{axis} ({unit})")
        self.across.title.setText(f"Along x, at y = {number(float(y[row_at]))} {unit} ({maps.scale.title})")
        self.down.title.setText(f"Along y, at x = {number(float(x[column_at]))} {unit} ({maps.scale.title})")
        step = f"; contours every {number(contour_step(high), 1)} {maps.scale.title}"
        described = maps.text_at((0, 0), row_at, column_at)
        self.text.setText(described + step)
