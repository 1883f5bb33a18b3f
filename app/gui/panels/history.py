"""The history panel: strip charts on a common time axis, their limits, and the verdict by these."""

import math
from collections.abc import Mapping
from copy import deepcopy
from functools import partial

import numpy as np
from PyQt6.QtCore import pyqtSignal
from PyQt6.QtWidgets import QApplication, QDialog, QGridLayout, QLineEdit, QMenu, QWidget

from app.bench.settings_form import typed_number
from app.gui.panels.panel import Check, DisplayState, Entries, MoreEntries, Panel, Request, Verdict
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button, Choice, Toggle, checkable, close_button
from app.gui.widgets.copies import ask_file
from app.gui.widgets.file_work import FileWork
from app.gui.widgets.layouts import Scrolled, column, fill_dialog, row
from app.gui.widgets.plot import Plot
from app.gui.widgets.presentation import NOTHING, number
from app.gui.widgets.texts import ElidedLabel, colour_text, label, mark_refused
from app.results.history import DELAY, FILL, RMS, TEMPERATURE, UNITS, History, LimitWatch, SeriesLimits, drift, sample
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
_PINNED = "Pinned coefficient"
_ENDS = "lowest", "highest"  # limits of a series
_ABOUT_LIMITS = (
    "Empty: no limit. The unit is that of Display, or the one that you type: 0.5 rad, 0.1 waves, 40 nm.\n"
    "The newest frame is compared five times a second; a crossing is over after two seconds within."
)


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

    def show_series(self, time_min: Floats, values: Floats, span_min: float, unit: str, limits: SeriesLimits) -> None:
        """Show values (time,) over the minutes before now, with gaps at NaN and pauses, and crossed or near limits."""
        known = np.isfinite(values)
        is_joined = np.append(np.diff(time_min[known]) * 60 < _PAUSE_S, False)
        self.curve.setData(time_min[known], values[known], connect=is_joined.astype(np.int32))
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 1.0)
        near_low, near_high = low - _NEAR * (high - low), high + _NEAR * (high - low)
        ends = (limits.lowest, limits.lowest >= near_low), (limits.highest, limits.highest <= near_high)
        for line, (limit, is_near) in zip(self.limit_lines, ends, strict=True):
            line.setVisible(is_near)
            if is_near:
                line.setValue(limit)
                low, high = min(low, limit), max(high, limit)
        margin = max(0.2 * (high - low), 1e-3 * abs(high), 1e-6)
        self.plot.set_ranges((-span_min, 0), (low - margin, high + margin))
        ticks = _ticks(low, high) if known.any() else []
        apart_px = self.plot.graphics.height() * (high - low) / (high - low + 2 * margin)
        has_room = apart_px > _TICK_LINES * self.fontMetrics().height()
        self.plot.axes["left"].setTicks([ticks[: 1 + has_room]])
        is_known = bool(known.size and known[-1])
        self.value.setText(f"{number(float(values[-1]))} {unit}" if is_known else NOTHING)
        colour_text(self.value, theme.RED if is_known and limits.broken_by(float(values[-1])) else theme.TEXT)

    def show_drift(self, values: Floats, samples: int) -> None:
        mean, sigma, peak_to_peak = drift(values[-samples:])
        spread = f"\N{GREEK SMALL LETTER SIGMA} {number(sigma, 2)}, peak to peak {number(peak_to_peak, 2)}"
        self.drift.setText(f"mean {number(mean, 4)}, {spread}")


class HistoryPanel(Panel):
    """Charts of the chosen series."""

    title = "History"

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self.history, self._watch = History(), LimitWatch()
        self._files = FileWork(self, self.warned.emit)
        self._newest: tuple[float, dict[str, float]] | None = None  # time and values of the newest sample
        self._pinned = ""  # name of a coefficient
        self._make_choices()
        self.form = LimitsForm(shown, self)
        self.form.changed.connect(self.refresh)
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
        samples = [(f"{samples} samples", samples) for samples in (20, 100, 500, 2000)]
        about = "Number of samples of mean, \N{GREEK SMALL LETTER SIGMA} and peak to peak; five a second"
        self.samples = Choice(about, samples, key="history/samples")
        for choice in (self.minutes, self.samples):
            choice.setCurrentIndex(1)
            choice.currentIndexChanged.connect(self.refresh)

    def _lay_out(self) -> None:
        about = "Set limits of RMS and the pinned coefficient: a crossing is reported, and red here"
        self.limits = Button("Limits…", about, self.form.show)
        self.charts: dict[str, StripChart] = {}
        charts = QWidget()
        self._rows = column(spacing=0, parent=charts)
        area = Scrolled(charts)  # many charts do not make the window larger than its screen
        area.setMinimumHeight(2 * self.fontMetrics().height())
        self.time_axis = _plot("minutes")
        self.time_axis.axes["left"].setTicks([[]])
        self.time_axis.graphics.setFixedHeight(2 * self.fontMetrics().height() + 16)
        header = row(self.series, self.limits, (QWidget(), 1), self.samples, self.minutes)
        column(header, (area, 1), self.time_axis, spacing=2, parent=self)

    def more_entries(self) -> MoreEntries:
        return (("Save all series as CSV", self.export_csv),)

    def menu_entries(self) -> Mapping[str, Entries]:
        return {"&View": (("Limits of the history…", "", self.form.show),)}

    def export_csv(self) -> None:
        path = ask_file(self, "Export the history", "history.csv", "Table (*.csv)")
        if path is not None:
            history = deepcopy(self.history)  # it goes on meanwhile
            tell = partial(self.informed.emit, f"saved {path}")
            self._files.run(partial(history.write_csv, path), lambda _: tell(), writes=str(path))

    def forget_bench(self) -> None:
        self.history, self._watch = History(), LimitWatch()
        self._newest = None

    def show_numbers(self) -> None:
        self.shown.verdict = self._judge(self.form.limits())

    def _judge(self, limits: Mapping[str, SeriesLimits]) -> Verdict:
        """Tell what has crossed a limit, once; return whether all values are within theirs."""
        if not limits:
            return Verdict()
        if self.shown.data_freshness.is_grey or self._newest is None:
            return Verdict(NOTHING, "The frame is not live")
        time_s, values = self._newest
        crossed, back = self._watch.follow(time_s, values, limits)
        if crossed:
            self.warned.emit("; ".join(self._in_words(name, values[name], limits[name]) for name in crossed))
            if self.form.beep.isChecked():
                QApplication.beep()
        elif back:
            self.informed.emit(f"within the limits again: {', '.join(back)}")
        lines = [self._in_words(name, values.get(name, math.nan), limit) for name, limit in limits.items()]
        is_known = all(math.isfinite(values.get(name, math.nan)) for name in limits)
        return Verdict("fail" if self._watch.beyond else "pass" if is_known else NOTHING, "\n".join(lines))

    def _in_words(self, name: str, value: float, limits: SeriesLimits) -> str:
        """Say how a phase relates to its limits, in the unit of the display."""
        unit, factor = self.shown.unit, self.shown.per_rad
        lowest, highest = (number(limit * factor) for limit in (limits.lowest, limits.highest))
        relation = limits.broken_by(value)
        if relation:
            end = lowest if relation == "below" else highest
            return f"{name} {number(value * factor)} {unit} is {relation} its limit of {end} {unit}"
        if not math.isfinite(value):
            return f"{name} is unknown"
        allowed = f"at most {highest}" if lowest == NOTHING else f"at least {lowest}"
        both = f"{lowest} ... {highest}" if NOTHING not in {lowest, highest} else allowed
        return f"{name} {number(value * factor)} {unit} is within its limits: {both} {unit}"

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
        self.form.use_pinned(name)
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
        limits = self.form.limits()
        for name, chart in self.charts.items():
            time_s, values = self.history.series(name)
            recent = time_s >= -60 * span_min
            unit, factor = (UNITS[name], 1.0) if name in UNITS else (self.shown.unit, self.shown.per_rad)
            values *= factor
            limit = limits.get(name, SeriesLimits())
            shown_limits = SeriesLimits(limit.lowest * factor, limit.highest * factor)
            chart.show_series(time_s[recent] / 60, values[recent], span_min, unit, shown_limits)
            chart.show_drift(values, self.samples.currentData())

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


class LimitLine(QLineEdit):
    """A phase with its unit; empty if there is no limit, red if it is no number."""

    def __init__(self, shown: DisplayState, key: str, name: str) -> None:
        super().__init__()
        self.setObjectName(key)  # under which its text is kept between two starts
        self.setAccessibleName(name)
        self.setMinimumWidth(110)  # px
        self._shown = shown
        self.editingFinished.connect(lambda: self.setText(self.with_unit()))

    def value_of(self, text: str) -> float:
        """Return the limit that a text stands for, rad; NaN if it is none."""
        value, unit = self.typed(text)
        return value / unit.per_rad(self._shown.wavelength_m)

    def typed(self, text: str) -> tuple[float, Unit]:
        """Return the number of a text, NaN if it is none, and its unit."""
        text = text.strip()
        unit = next((one for one in Unit if text.endswith(one)), self._shown.unit)
        number = typed_number(text.removesuffix(unit), "", 1.0)
        return math.nan if number is None else number, unit

    def with_unit(self) -> str:
        """Return the text with its unit, so that its meaning does not change with the display."""
        text = self.text().strip()
        value, unit = self.typed(text)
        return f"{text} {unit}" if math.isfinite(value) and not text.endswith(unit) else text


class LimitsForm(QDialog):
    """Limits of RMS and of the pinned coefficient, and whether a crossing beeps."""

    changed = pyqtSignal()

    def __init__(self, shown: DisplayState, parent: QWidget) -> None:
        super().__init__(parent)
        self.setWindowTitle("Limits of the history")
        self._pinned_label = label(_PINNED)
        self.beep = Toggle("Beep", "Beep when a value crosses a limit", key="history/beep")
        self.lines: dict[str, tuple[LimitLine, LimitLine]] = {}
        self._in_force: dict[str, tuple[str, str]] = {}  # the last texts of a series that were limits
        grid = QGridLayout()
        for at, text in enumerate(("", "at least", "at most")):
            grid.addWidget(label(text, "dim"), 0, at)
        for at, (name, shown_name) in enumerate(((RMS, label(RMS)), ("", self._pinned_label)), 1):
            grid.addWidget(shown_name, at, 0)
            keys = (f"history/{end} {name}" if name else "" for end in _ENDS)
            lowest, highest = (
                LimitLine(shown, key, f"{name or _PINNED}, {end}") for key, end in zip(keys, _ENDS, strict=True)
            )
            self.lines[name], self._in_force[name] = (lowest, highest), ("", "")
            for side, line in enumerate((lowest, highest), 1):
                line.textChanged.connect(lambda _, name=name: self._change(name))
                grid.addWidget(line, at, side)
        self.use_pinned("")
        about = label(_ABOUT_LIMITS, "dim")
        fill_dialog(self, grid, about, row(self.beep, (QWidget(), 1), close_button(self)))

    def _change(self, name: str) -> None:
        """Mark texts that are no number, and pairs that exclude all values; others come into force."""
        lower, upper = self.lines[name]
        are_crossed = lower.value_of(lower.text()) > upper.value_of(upper.text())
        reasons = []
        for line in (lower, upper):
            is_number = math.isfinite(line.typed(line.text())[0]) or not line.text().strip()
            why = "No value can be within" if are_crossed else ""
            reasons.append(why if is_number else "This is no number with its unit")
        if not any(reasons):
            self._in_force[name] = lower.with_unit(), upper.with_unit()
        holds = ": the former limits hold" if any(self._in_force[name]) else ""
        for line, why in zip((lower, upper), reasons, strict=True):
            line.setToolTip(why and why + holds)
            mark_refused(line, is_refused=bool(why))
        self.changed.emit()

    def limits(self) -> dict[str, SeriesLimits]:
        """Return the limits in force by series, rad."""
        found = dict[str, SeriesLimits]()
        for name, lines in self.lines.items():
            values = zip(_ENDS, lines, self._in_force[name], strict=True)
            typed = {end: line.value_of(text) for end, line, text in values if text}
            found[name or self._pinned] = SeriesLimits(**typed)
        return {name: limits for name, limits in found.items() if name and limits.is_set}

    def use_pinned(self, name: str) -> None:
        """Show the name of the pinned coefficient, which has no limits yet, or that there is none."""
        self._pinned = name
        self._pinned_label.setText(name or _PINNED)
        for line in self.lines[""]:
            line.setEnabled(bool(name))
            line.clear()
