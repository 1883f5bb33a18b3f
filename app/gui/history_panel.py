"""Strip charts of the recent minutes, one above the other on a common time axis."""

import numpy as np
from PyQt6.QtGui import QShowEvent
from PyQt6.QtWidgets import QWidget

from app.gui import theme
from app.gui.plot import Plot
from app.gui.presentation import NOTHING, number
from app.gui.widgets import Choice, ElidedLabel, column, row, toggle
from app.results.history import DELAY, FILL, RMS, TEMPERATURE, UNITS, History
from app.results.shown_wavefront import Unit
from reconstruction.arrays import Floats

_MINUTES = (1, 2, 5, 10, 20)
_HINT = "click a bar of Coefficients to add it"
_ABOUT = {
    RMS: "Mean RMS of the shown views",
    FILL: "Brightest pixel",
    DELAY: "Processing delay",
    TEMPERATURE: "Temperature of the camera's sensor",
}
_WIDEST = "\N{MINUS SIGN}00.00"  # number on an axis
_NAME = "Z00 astigmatism at 00"  # its width is that of all names
_LEAST_LINES = 2  # height of a chart


class StripChart(QWidget):
    """Name and newest value of a series, and its curve beside them."""

    def __init__(self, name: str, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.name, self.value = ElidedLabel(), ElidedLabel("title")
        self.name.setText(name)
        self.name.setToolTip(_ABOUT.get(name, name))
        labels = QWidget()
        column(self.name, self.value, spacing=0, parent=labels).addStretch()
        self.plot = _plot(None)
        self.plot.graphics.setMinimumHeight(_LEAST_LINES * self.fontMetrics().height() + 9)
        self.curve = self.plot.add_curve(theme.ACCENT, 1)
        row(labels, (self.plot, 1), parent=self)
        labels.setFixedWidth(name_width(self))

    def show_series(self, time_min: Floats, values: Floats, span_min: float, unit: str) -> None:
        """Show values (time,) over the minutes before now; NaN in gaps."""
        known = np.isfinite(values)
        self.curve.setData(time_min, values, connect="finite")
        low, high = (values[known].min(), values[known].max()) if known.any() else (0.0, 1.0)
        margin = max(0.2 * (high - low), 1e-3 * abs(high), 1e-6)
        self.plot.set_ranges((-span_min, 0), (low - margin, high + margin))
        ticks = [(float(end), number(float(end))) for end in (low, high)] if known.any() else []
        self.plot.axes["left"].setTicks([ticks[: 1 + (low < high)]])
        is_known = bool(known.size and known[-1])
        self.value.setText(f"{number(float(values[-1]))} {unit}" if is_known else NOTHING)


class HistoryPanel(QWidget):
    """Charts of the chosen series."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.history = History()
        self._pinned = ""
        self._unit, self._per_rad = Unit.RAD, 1.0
        self.toggles = {name: toggle(name, about) for name, about in _ABOUT.items()}
        self.toggles[RMS].setChecked(True)
        for chosen in self.toggles.values():
            chosen.toggled.connect(self._arrange)
        self.minutes = Choice()
        for minutes in _MINUTES:
            self.minutes.addItem(f"{minutes} min", minutes)
        self.minutes.setCurrentIndex(1)
        self.minutes.setToolTip("Time shown")
        self.minutes.currentIndexChanged.connect(self.refresh)
        self._hint = ElidedLabel("dim")
        self._hint.setText(_HINT)
        self.charts: dict[str, StripChart] = {}
        self._rows = column(spacing=0)
        self.time_axis = _plot("minutes")
        self.time_axis.axes["left"].setTicks([[]])
        self.time_axis.graphics.setFixedHeight(2 * self.fontMetrics().height() + 16)
        beside = QWidget()
        beside.setFixedWidth(name_width(self))
        header = row(*self.toggles.values(), (self._hint, 1), self.minutes)
        column(header, (self._rows, 1), row(beside, (self.time_axis, 1)), spacing=2, parent=self)
        self._arrange()

    def use_unit(self, unit: Unit, per_rad: float) -> None:
        """Set the unit of the phases."""
        self._unit, self._per_rad = unit, per_rad

    def pin(self, name: str) -> None:
        """Show the chart of a coefficient, or of none."""
        if self._pinned and self._pinned != name:
            self.history.forget(self._pinned)
        self._pinned = name
        self._hint.setText("" if name else _HINT)
        self._arrange()

    def add(self, time_s: float, values: dict[str, float]) -> None:
        """Add one sample of all series."""
        self.history.add(time_s, values)
        self.refresh()

    def refresh(self) -> None:
        """Draw the charts, if they are visible."""
        if not self.isVisible():
            return
        span_min = float(self.minutes.currentData())
        self.time_axis.set_ranges((-span_min, 0), (0, 1))
        for name, chart in self.charts.items():
            time_s, values = self.history.series(name)
            recent = time_s >= -60 * span_min
            values = values[recent] * (1.0 if name in UNITS else self._per_rad)
            chart.show_series(time_s[recent] / 60, values, span_min, UNITS.get(name, self._unit))

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802 - Qt's name
        """Draw what has come while hidden."""
        super().showEvent(event)
        self.refresh()

    def _arrange(self) -> None:
        """Make a chart for each chosen series."""
        names = [*filter(None, [self._pinned]), *(name for name, one in self.toggles.items() if one.isChecked())]
        for name in [name for name in self.charts if name not in names]:
            chart = self.charts.pop(name)
            self._rows.removeWidget(chart)
            chart.hide()
            chart.deleteLater()
        for index, name in enumerate(names):
            self.charts[name] = self.charts.pop(name) if name in self.charts else StripChart(name)  # in this order
            self._rows.insertWidget(index, self.charts[name], 1)
        self.refresh()


def name_width(widget: QWidget) -> int:
    """Return the width of the names, px."""
    return widget.fontMetrics().horizontalAdvance(_NAME)


def _plot(bottom: str | None) -> Plot:
    """Make a plot without title; those of one width have their left axes at the same place."""
    made = Plot("", bottom, widest=_WIDEST)
    made.title.hide()
    return made
