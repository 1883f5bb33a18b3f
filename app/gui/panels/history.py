"""The history panel: strip charts on a common time axis, their limits, and the verdict by these."""

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from PyQt6.QtGui import QAction
from PyQt6.QtWidgets import QApplication, QInputDialog, QMenu, QWidget

from app.gui.panels.panel import Check, DisplayState, Panel, Request, Verdict
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button, Choice, checkable
from app.gui.widgets.copies import as_table
from app.gui.widgets.layouts import Scrolled, column, row
from app.gui.widgets.plot import Plot
from app.gui.widgets.presentation import NOTHING, number
from app.gui.widgets.texts import ElidedLabel, colour_text, label
from app.results.history import DELAY, FILL, RMS, TEMPERATURE, UNITS, History, LimitWatch, drift, sample
from app.results.shown_wavefront import Unit
from reconstruction.arrays import Floats

_ABOUT = {
    RMS: "Mean RMS of the shown views",
    FILL: "Brightest pixel",
    DELAY: "Processing delay",
    TEMPERATURE: "Temperature of the camera's sensor",
}
_INTERVAL_S = 0.18  # every fifth time that the analyses are polled: five samples a second
_NEAR = 1.0  # ranges of the curve: a limit that is nearer to it is shown
_TICK_LINES = 1.1  # height between two numbers of an axis
_PAUSE_S = 2.0  # between two samples: no line joins them
_MOST = 1e6  # of a limit, in the unit of the display


class StripChart(QWidget):
    """Name, newest value and statistics of a series, and its curve below them."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.value, self.drift = label("", "title"), ElidedLabel("dim")
        named = label(name)
        named.setToolTip(_ABOUT.get(name, name))
        self.plot = _plot(None)
        self.plot.graphics.setMinimumHeight(2 * self.fontMetrics().height() + 9)
        self.curve = self.plot.add_curve(theme.ACCENT, 1)
        self.limit_lines = [self.plot.add_line(theme.RED, 0) for _ in range(2)]
        column(row(named, self.value, (self.drift, 1), spacing=10), (self.plot, 1), spacing=0, parent=self)

    def show_series(self, time_min: Floats, values: Floats, span_min: float, unit: str, limit: float) -> None:
        """Show values (time,) over the minutes before now, with gaps at NaN and pauses, and a crossed or near limit."""
        known = np.isfinite(values)
        is_joined = np.append(np.diff(time_min[known]) * 60 < _PAUSE_S, False)
        self.curve.setData(time_min[known], values[known], connect=is_joined.astype(np.int32))
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 1.0)
        near_low, near_high = low - _NEAR * (high - low), high + _NEAR * (high - low)
        ends = (-limit, -limit >= near_low), (limit, limit <= near_high)
        for line, (end, is_near) in zip(self.limit_lines, ends, strict=True):
            line.setVisible(is_near)
            if is_near:
                line.setValue(end)
                low, high = min(low, end), max(high, end)
        margin = max(0.2 * (high - low), 1e-3 * abs(high), 1e-6)
        self.plot.set_ranges((-span_min, 0), (low - margin, high + margin))
        ticks = _ticks(low, high) if known.any() else []
        apart_px = self.plot.graphics.height() * (high - low) / (high - low + 2 * margin)
        has_room = apart_px > _TICK_LINES * self.fontMetrics().height()
        self.plot.axes["left"].setTicks([ticks[: 1 + has_room]])
        is_known = bool(known.size and known[-1])
        self.value.setText(f"{number(float(values[-1]))} {unit}" if is_known else NOTHING)
        colour_text(self.value, theme.RED if is_known and abs(values[-1]) > limit else theme.TEXT)

        mean, sigma, peak_to_peak = drift(values)
        spread = f"\N{GREEK SMALL LETTER SIGMA} {number(sigma, 2)}, peak to peak {number(peak_to_peak, 2)}"
        self.drift.setText(f"mean {number(mean, 4)}, {spread}")


class HistoryPanel(Panel):
    """Charts of the chosen series."""

    title = "History"

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self.history, self._watch = History(), LimitWatch()
        self._newest: tuple[float, dict[str, float]] | None = None  # time and values of the newest sample
        self._pinned = ""  # name of a coefficient
        self._make_choices()
        self._lay_out()
        self._arrange()

    def _make_choices(self) -> None:
        self.toggles = {
            name: checkable(self, name, about, self._arrange, is_on=name == RMS, key=f"history/chart {index}")
            for index, (name, about) in enumerate(_ABOUT.items())
        }
        self.series = Button("Series", "Choose what is charted; a click on a bar of Coefficients adds it")
        menu = QMenu(self)
        menu.addActions(list(self.toggles.values()))
        self.series.setMenu(menu)
        minutes = [(f"{minutes} min", minutes) for minutes in (1, 2, 5, 10, 20)]
        self.minutes = Choice("Time shown", minutes, key="history/minutes")
        self.minutes.setCurrentIndex(1)
        self.minutes.currentIndexChanged.connect(self.refresh)
        self.beep = checkable(self, "Beep at a limit", "When a value crosses it", lambda _: None, key="history/beep")
        about = "Highest RMS and pinned coefficient allowed: the verdict says when the newest frame is beyond"
        self.limits, menu = Button("Limits", about), QMenu(self)
        menu.addAction("Limit of RMS…", lambda: self._ask_limit(RMS))
        self.limit_of_pinned = QAction("Limit of the pinned coefficient…", menu)
        self.limit_of_pinned.triggered.connect(lambda: self._ask_limit(self._pinned))
        self.limit_of_pinned.setEnabled(False)
        menu.addAction(self.limit_of_pinned)
        menu.addAction(self.beep)
        self.limits.setMenu(menu)
        self._limits_rad: dict[str, float] = {}  # by the name of their series

    def _lay_out(self) -> None:
        self.charts: dict[str, StripChart] = {}
        charts = QWidget()
        self._rows = column(spacing=0, parent=charts)
        area = Scrolled(charts)  # many charts do not make the window larger than its screen
        area.setMinimumHeight(2 * self.fontMetrics().height())
        self.time_axis = _plot("minutes")
        self.time_axis.axes["left"].setTicks([[]])
        self.time_axis.graphics.setFixedHeight(2 * self.fontMetrics().height() + 16)
        header = row(self.series, self.limits, (QWidget(), 1), self.minutes)
        column(header, (area, 1), self.time_axis, spacing=2, parent=self)

    def table(self) -> str:
        """Return all series, charted or not."""
        return as_table(*self.history.table())

    def forget_bench(self) -> None:
        self.history, self._watch = History(), LimitWatch()
        self._newest = None

    def show_numbers(self) -> None:
        self.shown.verdict = self._judge(self._limits_rad)

    def _judge(self, limits: Mapping[str, float]) -> Verdict:
        """Tell what has crossed a limit, once; return whether all values are within theirs, rad."""
        if not limits:
            return Verdict()
        if self.shown.data_freshness.is_grey or self._newest is None:
            return Verdict(NOTHING, "The frame is not live")
        time_s, values = self._newest
        crossed, back = self._watch.follow(time_s, values, limits)
        if crossed:
            self.warned.emit("; ".join(self._in_words(name, values[name], limits[name]) for name in crossed))
            if self.beep.isChecked():
                QApplication.beep()
        elif back:
            self.informed.emit(f"within the limits again: {', '.join(back)}")
        lines = [self._in_words(name, values.get(name, math.nan), limit) for name, limit in limits.items()]
        is_known = all(math.isfinite(values.get(name, math.nan)) for name in limits)
        return Verdict("fail" if self._watch.beyond else "pass" if is_known else NOTHING, "\n".join(lines))

    def _in_words(self, name: str, value: float, limit: float) -> str:
        """Say how a phase relates to its limit, in the unit of the display."""
        unit, factor = self.shown.unit, self.shown.per_rad
        if not math.isfinite(value):
            return f"{name} is unknown"
        relation = "beyond" if abs(value) > limit else "within"
        return f"{name} {number(value * factor)} {unit} is {relation} its limit of {number(limit * factor)} {unit}"

    def _ask_limit(self, series: str) -> None:
        """Ask for the highest value of a series, in the unit of the display if that is known."""
        unit, factor = self.shown.unit, self.shown.per_rad
        if not math.isfinite(factor):
            unit, factor = Unit.RAD, 1.0
        text, before = f"Highest {series} allowed ({unit}); 0: no limit", self._limits_rad.pop(series, 0.0)
        limit, is_given = QInputDialog.getDouble(self, "Limit", text, before * factor, 0, _MOST, 3)
        if limit_rad := limit / factor if is_given else before:
            self._limits_rad[series] = limit_rad
        self.refresh()

    @property
    def is_needed(self) -> bool:
        """True: it samples measurements also while it is hidden."""
        return True

    def request(self) -> Request | None:
        measurement, wavefront, status = self.shown.measurement, self.shown.wavefront, self.shown.status
        if measurement is None or status is None:
            return None
        full_scale, temperature_c = status.capabilities.full_scale, status.temperature_c
        take = partial(sample, measurement, wavefront, full_scale=full_scale, temperature_c=temperature_c)
        replayed = self.shown.replayed

        def of_recording(_: Check) -> tuple[float, dict[str, float]]:
            time_s, values = take()
            return time_s if replayed is None else replayed[1], values

        return Request(measurement, None, of_recording, _INTERVAL_S)

    def show_result(self, found: tuple[float, dict[str, float]]) -> None:
        time_s, values = found
        if self._pinned and self.shown.pinned_rad is not None:
            values[self._pinned] = self.shown.pinned_rad
        self.add(time_s, values)

    def pin(self, name: str) -> None:
        if self._pinned and self._pinned != name:
            self.history.forget(self._pinned)
        self._pinned = name
        self._limits_rad = {each: limit for each, limit in self._limits_rad.items() if each == RMS}
        self.limit_of_pinned.setEnabled(bool(name))
        self._arrange()

    def add(self, time_s: float, values: dict[str, float]) -> None:
        if self._newest is not None and time_s < self._newest[0]:  # a replay went back
            self.history = History()
        self.history.add(time_s, values)
        self._newest = time_s, values
        self.refresh()

    def refresh(self) -> None:
        if not self.isVisible():
            return
        span_min = float(self.minutes.currentData())
        self.time_axis.set_ranges((-span_min, 0), (0, 1))
        for name, chart in self.charts.items():
            time_s, values = self.history.series(name)
            recent = time_s >= -60 * span_min
            unit, factor = (UNITS[name], 1.0) if name in UNITS else (self.shown.unit, self.shown.per_rad)
            values *= factor
            limit = self._limits_rad.get(name, math.inf) * factor
            chart.show_series(time_s[recent] / 60, values[recent], span_min, unit, limit)

    def catch_up(self) -> None:
        super().catch_up()
        self.refresh()

    def _arrange(self) -> None:
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


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Return both ends of an axis with as many digits as tell them apart."""
    digits = next((count for count in range(3, 8) if number(low, count) != number(high, count)), 8)
    return [(end, number(end, digits)) for end in (low, high)]


def _plot(bottom: str | None) -> Plot:
    """Make a plot without title; those of one width have their left axes at the same place."""
    made = Plot("", bottom, widest="\N{MINUS SIGN}00.00")
    made.title.hide()
    return made
