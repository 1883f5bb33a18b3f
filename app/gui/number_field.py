"""Number field: a value with its unit, typed in any notation and refused outside its range."""

import math
import re

from PyQt6.QtCore import QEvent, QLocale, Qt, pyqtSignal
from PyQt6.QtGui import QFocusEvent, QKeyEvent, QValidator, QWheelEvent
from PyQt6.QtWidgets import QAbstractSpinBox, QDoubleSpinBox, QWidget

from app.gui import theme
from app.gui.widgets import ENTER
from drivers.interface import Range

_BUTTONS_WIDTH = 26  # px, with the frame
_NUMBER = re.compile(r"([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*(\D*)")
_LETTERS = 4  # of a word that may be shortened
_PREFIXES = {"": 1.0, "m": 1e-3, "u": 1e-6, "\N{MICRO SIGN}": 1e-6, "\N{GREEK SMALL LETTER MU}": 1e-6}
_COMMANDS = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.AltModifier | Qt.KeyboardModifier.MetaModifier


class NumberField(QDoubleSpinBox):
    """Shows a value in a convenient unit and emits it in SI units when the user enters it.

    A comma or a point separates decimals, whatever the language of the desktop; other prefixes of the unit are
    understood. A number outside the range is shown in red and not emitted.
    """

    entered = pyqtSignal(float)
    refused = pyqtSignal(str)  # why what is typed cannot be used; empty as soon as it can

    def __init__(
        self,
        *,
        tool_tip: str,
        name: str = "",
        unit: str = "",
        decimals: int = 0,
        lowest: str = "",
        parent: QWidget | None = None,
    ) -> None:
        """Show values in `unit`, such as "ms", and the lowest value as the word `lowest`; errors start with `name`."""
        super().__init__(parent)
        self._name, self._unit, self._allowed = name, unit, Range(0, 0)
        self._shown_problem = ""
        self._latest: tuple[float, Range] | None = None  # value in force and its range, in SI units
        self._factor = _PREFIXES[unit[:-1]]  # SI units have one letter
        self.setLocale(QLocale.c())  # a point, as in the rest of the window
        self.setGroupSeparatorShown(False)
        self.setSuffix(f" {unit}" if unit else "")
        self.setDecimals(decimals)
        self.setSpecialValueText(lowest)
        self.setToolTip(tool_tip)
        self.setKeyboardTracking(False)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)  # not by the wheel
        self.setCorrectionMode(QAbstractSpinBox.CorrectionMode.CorrectToPreviousValue)
        if decimals:
            self.setStepType(QAbstractSpinBox.StepType.AdaptiveDecimalStepType)
        usual = max((f"{0:.{decimals}f}".rjust(decimals + 5, "0") + self.suffix(), lowest), key=len)
        self.setMinimumWidth(self.fontMetrics().horizontalAdvance(usual) + _BUTTONS_WIDTH)  # independent of the range
        self.valueChanged.connect(self._enter)
        if (line := self.lineEdit()) is not None:
            line.textChanged.connect(self._mark)

    def show_value(self, value: float, allowed: Range) -> None:
        """Show a value and set the allowed range, both in SI units, without emitting; what is typed stays."""
        self._latest, line = (value, allowed), self.lineEdit()
        if line is not None and line.isModified() and self.hasFocus():
            return
        self._allowed = allowed
        self.blockSignals(True)
        self.setRange(allowed.minimum / self._factor, allowed.maximum / self._factor)
        self.setValue(value / self._factor)
        self.blockSignals(False)
        self._mark()

    def edit(self) -> None:
        """Take the focus and select the value, so that typing replaces it."""
        self.setFocus()
        self.selectAll()

    def commit(self) -> bool:
        """Use what is typed; return whether that is possible. Otherwise it stays, in red."""
        if problem := self._problem():
            self.refused.emit(problem)
            return False
        self.interpretText()
        return True

    def validate(self, text: str | None, position: int) -> tuple[QValidator.State, str, int]:
        """Let everything be typed; only a number within the range is acceptable."""
        state = QValidator.State.Intermediate if self._problem(text) else QValidator.State.Acceptable
        return state, text or "", position

    def valueFromText(self, text: str | None) -> float:  # noqa: N802 - Qt's name
        """Return the typed value in the shown unit."""
        value = self._parse(text or "")
        return self.value() if value is None else value

    def event(self, event: QEvent | None) -> bool:
        """Keep typed keys from the shortcuts; Return enters, Esc restores, and both leave the field."""
        if not isinstance(event, QKeyEvent):
            return super().event(event)
        key, kind = event.key(), event.type()
        ends = key == Qt.Key.Key_Escape or key in ENTER
        if kind == QEvent.Type.ShortcutOverride:
            is_typed = bool(event.text()) and not event.modifiers() & _COMMANDS
            if is_typed and key == Qt.Key.Key_L:  # in no number: it switches the light
                event.ignore()
                return False
            if ends or is_typed:
                event.accept()
                return True
        elif kind == QEvent.Type.KeyPress and ends:
            if key == Qt.Key.Key_Escape:
                self._restore()
            elif not self.commit():
                return True
            self.clearFocus()  # digits are shortcuts again
            return True
        return super().event(event)

    def focusOutEvent(self, event: QFocusEvent | None) -> None:  # noqa: N802 - Qt's name
        """Enter the value; restore the old one if that is refused."""
        if problem := self._problem():
            self._restore()
            self.refused.emit(problem)
        super().focusOutEvent(event)

    def wheelEvent(self, event: QWheelEvent | None) -> None:  # noqa: N802 - Qt's name
        """Ignore the wheel without the focus: scrolling past must not change a device."""
        if event is not None and not self.hasFocus():
            event.ignore()
        else:
            super().wheelEvent(event)

    def _parse(self, text: str) -> float | None:
        """Return a typed value in the shown unit; None if it is no number with this unit."""
        text = self._typed(text)
        if self._is_word(text):
            return self.minimum()
        match = _NUMBER.fullmatch(text)
        if match is None:
            return None
        value, unit = float(match[1].replace(",", ".")), match[2].strip()
        if math.isinf(value):
            return None
        if not unit:
            return value
        if not self._unit or unit[-1:].lower() != self._unit[-1].lower() or unit[:-1] not in _PREFIXES:
            return None
        return value * _PREFIXES[unit[:-1]] / self._factor

    def _typed(self, text: str) -> str:
        """Return a text without the suffix, which stays while the number is replaced."""
        return text.removesuffix(self.suffix()).strip()

    def _problem(self, text: str | None = None) -> str:
        """Return why what is typed cannot be used; empty if it can."""
        text = self.text() if text is None else text
        value = self._parse(text)
        word, lowest = self.specialValueText(), self.minimum() + bool(self.specialValueText())
        allowed = (
            f"{self._worded(lowest)} ... {self._worded(self.maximum())}{self.suffix()}{f', or {word}' * bool(word)}"
        )
        about = f"{self._name} {self._typed(text)}".strip()
        if value is None:
            return f"{about}: type a number {f'in {self._unit}, ' if self._unit else ''}{allowed}"
        if not self.decimals() and value != round(value):
            return f"{about}: only whole numbers {allowed} are allowed"
        rounding = 0.5001 * 10.0 ** -self.decimals()
        is_beyond = not lowest - rounding <= value <= self.maximum() + rounding
        if is_beyond and not self._is_word(self._typed(text)):
            return f"{about} is outside the allowed range {allowed}: not changed"
        return ""

    def _is_word(self, text: str) -> bool:
        """True for the word of the lowest value, its first letters, and 0."""
        word = self.specialValueText()
        return bool(word) and (text == "0" or (len(text) >= _LETTERS and word.startswith(text.lower())))

    def _worded(self, value: float) -> str:
        if self.specialValueText() and math.isclose(value, self.minimum()):
            return self.specialValueText()
        return f"{round(value, self.decimals()):.12g}"

    def _restore(self) -> None:
        """Show the value in force again."""
        if (line := self.lineEdit()) is not None:
            word = self.specialValueText() if self.value() == self.minimum() else ""
            line.setText(word or self.textFromValue(self.value()) + self.suffix())
        if self._latest is not None:
            self.show_value(*self._latest)

    def _mark(self, _: str = "") -> None:
        """Show in red what would be refused, and say why."""
        problem = self._problem()
        if problem != self._shown_problem:
            self._shown_problem = problem
            self.setStyleSheet(f"color: {theme.RED.name()};" if problem else "")
            self.refused.emit(problem)

    def _enter(self, value: float) -> None:
        """Emit the entered value; rounding to the shown decimals must not leave the range."""
        self.entered.emit(min(max(value * self._factor, self._allowed.minimum), self._allowed.maximum))
