"""The form of the limits of the history, two for each series."""

import math

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtWidgets import QDialog, QGridLayout, QLabel, QWidget

from app.bench.settings_form import typed_number
from app.gui.panels.panel import Shown
from app.gui.widgets.buttons import Button, Toggle
from app.gui.widgets.fields import NumberLine
from app.gui.widgets.layouts import column, row
from app.gui.widgets.texts import label, mark_refused
from app.results.history import UNITS, SeriesLimits
from app.results.shown_wavefront import Unit

_PINNED = "Pinned coefficient"
_ENDS = "lowest", "highest"  # limits of a series
_ABOUT_LIMITS = (
    "Empty: no limit. Phases are in the unit of Display, or in the one that you type: 0.5 rad, 0.1 waves, 40 nm.\n"
    "The newest frame is compared five times a second; a crossing is over after two seconds within."
)


class LimitLine(NumberLine):
    """A number with its unit; empty if there is no limit, red if it is no number."""

    def __init__(self, shown: Shown, series: str, key: str) -> None:
        super().__init__()
        self.setObjectName(key)  # under which its text is kept between two starts
        self.setMinimumWidth(110)  # px
        self._shown, self._unit = shown, UNITS.get(series, "").partition(" ")[0]
        self.editingFinished.connect(lambda: self.setText(self.with_unit()))

    def value_of(self, text: str) -> float:
        """Return the limit that a text stands for, phases in rad; NaN if it is none."""
        value, unit = self.typed(text)
        return value if self._unit else value / Unit(unit).per_rad(self._shown.wavelength_m)

    def typed(self, text: str) -> tuple[float, str]:
        """Return the number of a text, NaN if it is none, and its unit."""
        text = text.strip()
        units = [self._unit] if self._unit else [self._shown.unit, *Unit]
        unit = next((one for one in units if text.endswith(one)), "")
        number = typed_number(text.removesuffix(unit), "", 1.0)
        return math.nan if number is None else number, unit or units[0]

    def with_unit(self) -> str:
        """Return the text with its unit, so that it still means the same in another unit of the display."""
        text = self.text().strip()
        value, unit = self.typed(text)
        return f"{text} {unit}" if math.isfinite(value) and not text.endswith(unit) else text


class LimitsForm(QDialog):
    """One row for each series, and whether a crossing beeps."""

    changed = pyqtSignal()

    def __init__(self, shown: Shown, series: tuple[str, ...], parent: QWidget) -> None:
        super().__init__(parent)
        self.setWindowTitle("Limits of the history")
        self._shown, self._pinned, self._pinned_label = shown, "", label(_PINNED)
        self.beep = Toggle("Beep", "Beep when a value crosses a limit", key="history/beep")
        self.lines: dict[str, tuple[LimitLine, LimitLine]] = {}
        self._in_force: dict[str, tuple[str, str]] = {}  # the last texts of a series that were limits
        grid = QGridLayout()
        for at, text in enumerate(("", "at least", "at most")):
            grid.addWidget(label(text, "dim"), 0, at)
        for name in series:
            self._add_row(grid, name, label(name))
        self._add_row(grid, "", self._pinned_label)
        self.use_pinned("")
        about = label(_ABOUT_LIMITS, "dim")
        ends = row(self.beep, (QWidget(), 1), Button("Close", "Close (Esc)", self.close))
        column(grid, about, ends, spacing=12, parent=self).setContentsMargins(14, 12, 14, 12)

    def _add_row(self, grid: QGridLayout, name: str, shown_name: QLabel) -> None:
        at = grid.rowCount()
        grid.addWidget(shown_name, at, 0)
        keys = [f"history/{end} {name}" if name else "" for end in _ENDS]
        self.lines[name] = LimitLine(self._shown, name, keys[0]), LimitLine(self._shown, name, keys[1])
        self._in_force[name] = "", ""
        for side, line in enumerate(self.lines[name], 1):
            line.textChanged.connect(lambda _, name=name: self._change(name))
            grid.addWidget(line, at, side)

    def _change(self, name: str) -> None:
        """Mark texts that are no number, and pairs whose lower limit is above the upper one; others come into force."""
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
        """Return the limits in force by series, phases in rad."""
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
