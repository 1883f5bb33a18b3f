"""Strip charts of the recent minutes on a common time axis."""

import numpy as np
from PyQt6.QtGui import QShowEvent
from PyQt6.QtWidgets import QWidget

from app.gui import theme
from app.gui.plot import Plot
from app.gui.presentation import number
from app.gui.widgets import Choice, ElidedLabel, column, row, toggle
from app.results.history import DELAY, FILL, RMS, TEMPERATURE, History

_MINUTES = (1, 2, 5, 10, 20)
_HINT = "click a bar of Coefficients to add it"
_ALWAYS = (RMS, FILL, DELAY, TEMPERATURE)


class HistoryPanel(QWidget):
    """Charts of the chosen series."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.history = History()
        self._pinned = ""
        self.toggles = {name: toggle(name.split(" (")[0], f"Show {name}", self._arrange) for name in _ALWAYS}
        self.toggles[RMS].setChecked(True)
        self.minutes = Choice()
        for minutes in _MINUTES:
            self.minutes.addItem(f"{minutes} min", minutes)
        self.minutes.setCurrentIndex(1)
        self.minutes.setToolTip("Time shown")
        self.minutes.currentIndexChanged.connect(self.refresh)
        self._hint = ElidedLabel("dim")
        self._hint.setText(_HINT)
        self._charts: dict[str, Plot] = {}
        self._rows = row(spacing=12)
        header = row(*self.toggles.values(), (self._hint, 1), self.minutes)
        column(header, (self._rows, 1), parent=self)
        self._arrange()

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
        span_s = 60.0 * self.minutes.currentData()
        for name, chart in self._charts.items():
            time_s, values = self.history.series(name)
            recent = time_s >= -span_s
            time_s, values = time_s[recent], values[recent]
            known = np.isfinite(values)
            curve = chart.curves[0]
            curve.setData(time_s / 60, values, connect="finite")
            low, high = (values[known].min(), values[known].max()) if known.any() else (0.0, 1.0)
            margin = max(0.1 * (high - low), 1e-3 * abs(high), 1e-6)
            chart.set_ranges((-span_s / 60, 0), (low - margin, high + margin))
            newest = number(float(values[-1])) if known.size and known[-1] else number(float("nan"))
            chart.title.setText(f"{name}: {newest}")

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802 - Qt's name
        """Draw what has come while hidden."""
        super().showEvent(event)
        self.refresh()

    def _arrange(self) -> None:
        """Make a chart for each chosen series."""
        names = [*filter(None, [self._pinned]), *(name for name, one in self.toggles.items() if one.isChecked())]
        for name in [name for name in self._charts if name not in names]:
            chart = self._charts.pop(name)
            self._rows.removeWidget(chart)
            chart.deleteLater()
        for index, name in enumerate(names):
            if name in self._charts:
                chart = self._charts.pop(name)
            else:
                chart = Plot(name, "minutes", widest="\N{MINUS SIGN}00.00")
                chart.add_curve(theme.ACCENT, 1)
            self._charts[name] = chart
            self._rows.insertWidget(index, chart, 1)
        self.refresh()
