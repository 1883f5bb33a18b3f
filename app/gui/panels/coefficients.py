"""The coefficients panel: bars with errors, a table, and the field map of the pinned coefficient."""

import math
from typing import Any

import numpy as np
import pyqtgraph as pg
from PyQt6.QtCore import QSignalBlocker, Qt, pyqtSignal
from PyQt6.QtWidgets import QAbstractItemView, QHeaderView, QStackedWidget, QTableWidget, QTableWidgetItem

from app.gui.panels.panel import DisplayState, Panel, Request
from app.gui.widgets import theme
from app.gui.widgets.buttons import Choice, Toggle
from app.gui.widgets.layouts import column, row
from app.gui.widgets.plot import Plot
from app.gui.widgets.presentation import AdaptiveScale, diverging, signed, with_error
from app.gui.widgets.view_grid import Maps, ViewGrid
from app.results.coefficients import ModeChoice, ModeCoefficients, mode_coefficients
from reconstruction.modes.pupil_modes import BASES


class CoefficientsPanel(Panel):
    """Shows the coefficients of the selected view or of one field mode."""

    title = "Coefficients"
    pinned = pyqtSignal(str)  # name of the pinned coefficient; empty: none

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self._found: ModeCoefficients | None = None
        self._mapped: int | None = None
        self._scale, self._map_scale = AdaptiveScale(), AdaptiveScale()
        self.basis = Choice(
            "Modes of the bars; over the lattice (Legendre) or the circle of the pupil (Zernike)",
            [(BASES[name].title, name) for name in sorted(BASES, reverse=True)],  # Zernike first
            lambda: self.pin(None),
            key="coefficients/basis",
        )
        about = "The selected view as shown, or the coefficients e_pq of one field mode"
        self.of = Choice(about, [("Selected view", None)], lambda: self.pin(None))
        for choice in (self.of, self.basis):
            choice.setSizeAdjustPolicy(Choice.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
            choice.setMinimumContentsLength(10)
        self.table_toggle = Toggle("Table", "Numbers with one standard deviation", self._turn)
        self.plot = Plot("Coefficients", "", widest="\N{MINUS SIGN}0.000")
        self.plot.setToolTip("Click a bar to record its history and to map it over the field; click it again to stop")
        self._bars = pg.BarGraphItem(x=[0], height=[0], width=0.7, pen=None)
        self.plot.view.addItem(self._bars)
        self._errors = pg.PlotCurveItem(connect="pairs")
        self.plot.view.addItem(self._errors)
        self.plot.graphics.scene().sigMouseClicked.connect(self._click)
        self.numbers = _Table()
        self.numbers.setAccessibleName("Coefficients")
        self.numbers.cellClicked.connect(lambda row, _: self.pin(None if row + 1 == self._mapped else row + 1))
        self._stack = QStackedWidget()
        self._stack.addWidget(self.plot)
        self._stack.addWidget(self.numbers)
        self.map = ViewGrid((80, 50), empty="Click a coefficient\nto map it over the field", is_captioned=False)
        self.map.setAccessibleName("Coefficient over the field")
        header = row((self.plot.title, 1), self.of, self.basis, self.table_toggle)
        column(header, (row((self._stack, 3), (self.map, 2), spacing=12), 1), parent=self)
        theme.follow(self.plot, self._colour)

    def _colour(self) -> None:
        self._errors.setPen(pg.mkPen(theme.TEXT, width=1))
        if self._found is not None:
            self.show_result(self._found)

    @property
    def name(self) -> str:
        """Name of the pinned coefficient; empty without one."""
        if self._mapped is None:
            return ""
        of = self.of.currentText() if self.of.currentIndex() else "view"
        return f"{BASES[self.basis.currentData()].names(self._mapped + 1)[-1]}, {of}"

    @property
    def is_needed(self) -> bool:
        """True if it is seen, or the history records a coefficient."""
        return self._mapped is not None or self.isVisible()

    def request(self) -> Request | None:
        wavefront, view = self.shown.wavefront, self.shown.view
        if wavefront is None or view is None:
            return None
        self._offer(wavefront.displacement.modes.count)
        choice = ModeChoice(self.basis.currentData(), self.of.currentData(), view, self._mapped)
        return Request(wavefront, choice, lambda _: mode_coefficients(wavefront, choice))

    def show_nothing(self) -> None:
        self.show_result(None)

    def forget_bench(self) -> None:
        self.pin(None)

    def show_result(self, found: ModeCoefficients | None) -> None:
        self._found = found
        self.shown.pinned_rad = self._pinned_rad()
        if not self.isVisible():
            return
        values, sigma = np.zeros(1), np.zeros(1)
        names: tuple[str, ...] = ("",)
        if found is not None and np.isfinite(found.rad).any():
            values, sigma, names = found.rad * self.shown.per_rad, found.sigma_rad * self.shown.per_rad, found.names
        index = np.arange(1, len(values))
        is_pinned = index == self._mapped
        brushes = [pg.mkBrush(theme.AMBER if one else theme.ACCENT) for one in is_pinned]
        self._bars.setOpts(x=index, height=values[1:], width=0.7, brushes=brushes)
        ends = np.stack([values[1:] - sigma[1:], values[1:] + sigma[1:]], axis=1)
        known = np.isfinite(ends).all(axis=1)
        self._errors.setData(np.repeat(index[known], 2).astype(float), ends[known].ravel())
        limit = self._scale.follow(1.1 * float(np.max(np.abs(np.nan_to_num(ends)), initial=1e-6)))
        self.plot.set_ranges((0, len(values)), (-limit, limit))
        self.plot.axes["left"].setTicks([[(-limit, signed(-limit)), (0, "0"), (limit, signed(limit))]])
        label_px = 1.3 * self.fontMetrics().horizontalAdvance("Z000")
        step = math.ceil(label_px * len(values) / max(self.plot.graphics.width(), 1))
        self.plot.axes["bottom"].setTicks([[(at, names[at].split(" ")[0]) for at in index[::step]]])
        pinned = self._described(found, self._mapped) if self._mapped is not None and found else ""
        self.plot.title.setText(pinned or f"Coefficients ({self.shown.unit})")
        numbers = zip(names[1:], values[1:], sigma[1:], strict=True)
        self.numbers.show_rows([(name, *with_error(value, one)) for name, value, one in numbers], self.shown.unit)
        self._show_map(found)

    def table(self) -> str:
        return "" if self._found is None else self._found.table(self.shown.unit, self.shown.per_rad)

    def pin(self, mode: int | None) -> None:
        """Record and map a mode from now on, or none."""
        self._mapped = mode
        self.pinned.emit(self.name)
        self.show_result(self._found)

    def _pinned_rad(self) -> float | None:
        """Return the present value of the pinned coefficient, if it is known."""
        found = self._found
        if found is None or self._mapped is None or found.choice.mapped != self._mapped:
            return None
        return float(found.rad[self._mapped])

    def _described(self, found: ModeCoefficients, mode: int) -> str:
        value, sigma = found.rad[mode] * self.shown.per_rad, found.sigma_rad[mode] * self.shown.per_rad
        text, error = with_error(value, sigma)
        error = f" \N{PLUS-MINUS SIGN} {error}" if np.isfinite(sigma) else ""
        return f"{text}{error} {self.shown.unit}, {found.names[mode]}"

    def _show_map(self, found: ModeCoefficients | None) -> None:
        if found is None or found.field_map is None or self._mapped != found.choice.mapped:
            self.map.show_maps(None)
            return
        values = found.field_map * self.shown.per_rad
        limit = self._map_scale.follow(float(np.nanmax(np.abs(values), initial=1e-6)))
        name = found.names[found.choice.mapped or 0]
        unit = self.shown.unit
        scale = diverging(limit, unit)
        maps = Maps(values[None, None], scale, lambda *at: f"{name}: {signed(at[-1])} {unit}", is_smooth=True)
        self.map.show_maps(maps)

    def _offer(self, field_modes: int) -> None:
        if self.of.count() == field_modes + 1:
            return
        with QSignalBlocker(self.of):
            while self.of.count() > 1:
                self.of.removeItem(1)
            for index, name in enumerate(BASES["legendre"].names(field_modes)):
                self.of.addItem(f"Field mode {index}: {name.split(' ', 1)[1].replace('piston', 'mean')}", index)

    def _turn(self) -> None:
        self._stack.setCurrentIndex(int(self.table_toggle.isChecked()))
        self.show_result(self._found)

    def _click(self, event: Any) -> None:  # pyqtgraph declares no types
        mode = round(self.plot.view.mapSceneToView(event.scenePos()).x())
        if event.button() == Qt.MouseButton.LeftButton and self._found is not None and 1 <= mode < len(self._found.rad):
            self.pin(None if mode == self._mapped else mode)


class _Table(QTableWidget):
    """Name, value and standard deviation of every mode."""

    def __init__(self) -> None:
        super().__init__(0, 3)
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        if (header := self.verticalHeader()) is not None:
            header.hide()
            header.setDefaultSectionSize(self.fontMetrics().height() + 6)
        if (header := self.horizontalHeader()) is not None:
            header.setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
            header.setSectionResizeMode(0, QHeaderView.ResizeMode.ResizeToContents)  # the names have different lengths

    def show_rows(self, rows: list[tuple[str, str, str]], unit: str) -> None:
        """Show texts; selection and position stay."""
        if not self.isVisible():
            return
        self.setHorizontalHeaderLabels(["mode", unit, "1\N{GREEK SMALL LETTER SIGMA}"])
        self.setRowCount(len(rows))
        for index, texts in enumerate(rows):
            for at, text in enumerate(texts):
                item = self.item(index, at)
                if item is None:
                    item = QTableWidgetItem()
                    if at:  # a number
                        item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
                    self.setItem(index, at, item)
                item.setText(text)
