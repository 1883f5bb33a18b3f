"""Fields for numbers with units and for texts, which keep their keys from the window's shortcuts."""

from PyQt6.QtCore import QEvent, QLocale, QObject, QSignalBlocker, Qt, pyqtSignal
from PyQt6.QtGui import QFocusEvent, QKeyEvent, QValidator
from PyQt6.QtWidgets import QAbstractSpinBox, QApplication, QDoubleSpinBox, QLineEdit, QWidget

from app.bench.settings_form import typed_number
from app.gui.widgets.buttons import ENTER, keeps_key, scrolls_past
from app.gui.widgets.texts import mark_refused
from drivers.interface import Range

BUTTONS_WIDTH_PX = 26  # with the frame
_COMMANDS = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.AltModifier | Qt.KeyboardModifier.MetaModifier


class NumberField(QDoubleSpinBox):
    """Shows a value in a convenient unit and emits it in SI units when the user enters it.

    A comma or a point separates decimals, whatever the language of the desktop; other prefixes of the unit are
    understood. A number outside the range is shown in red and not emitted.
    """

    entered = pyqtSignal(float)
    refused = pyqtSignal(str)  # why what is typed cannot be used; empty as soon as it can

    def __init__(self, *, tool_tip: str, name: str = "", unit: str = "", decimals: int = 0, lowest: str = "") -> None:
        """Show values in `unit`, such as "ms", the lowest as the word `lowest`; errors start with `name`."""
        super().__init__()
        self.setAccessibleName(f"{name} ({unit})" if unit else name)
        self._name, self._unit, self._allowed = name, unit, Range(0, 0)
        self._shown_problem = ""
        self._latest: tuple[float, Range] | None = None  # value in force and its range, in SI units
        self._factor = 1e-3 if unit[:-1] == "m" else 1.0  # SI units have one letter
        self.setLocale(QLocale.c())  # a point, as in the rest of the window
        self.setGroupSeparatorShown(False)
        self.setDecimals(decimals)
        self.setSpecialValueText(lowest)
        self.setToolTip(tool_tip)
        self.setKeyboardTracking(False)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)  # not by the wheel
        self.setCorrectionMode(QAbstractSpinBox.CorrectionMode.CorrectToPreviousValue)
        if decimals:
            self.setStepType(QAbstractSpinBox.StepType.AdaptiveDecimalStepType)
        usual = max((f"{0:.{decimals}f}".rjust(decimals + 5, "0"), lowest), key=len)
        self.setMinimumWidth(self.fontMetrics().horizontalAdvance(usual) + BUTTONS_WIDTH_PX)  # independent of the range
        self.setMinimumHeight(self.fontMetrics().height() + 8)  # as a choice next to it
        self.valueChanged.connect(self._enter)
        if (line := self.lineEdit()) is not None:
            line.textChanged.connect(self._mark)

    def show_value(self, value: float, allowed: Range) -> None:
        """Show a value and set its range, both in SI units, without emitting; what is typed stays."""
        self._latest, line = (value, allowed), self.lineEdit()
        if line is not None and line.isModified() and self.hasFocus():
            return
        self._allowed = allowed
        with QSignalBlocker(self):
            self.setRange(allowed.minimum / self._factor, allowed.maximum / self._factor)
            self.setValue(value / self._factor)
        self._mark()

    def edit(self) -> None:
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
        value = self._parse(text or "")
        return self.value() if value is None else value

    def event(self, event: QEvent | None) -> bool:
        """Keep typed keys from the shortcuts; Return enters, Esc restores, and both leave the field."""
        if scrolls_past(event, self):
            return False
        if not isinstance(event, QKeyEvent):
            return super().event(event)
        key, kind = event.key(), event.type()
        ends = key == Qt.Key.Key_Escape or key in ENTER
        if kind == QEvent.Type.ShortcutOverride:
            is_typed = bool(event.text()) and not event.modifiers() & _COMMANDS
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

    def _parse(self, text: str) -> float | None:
        """Return a typed value in the shown unit; None if it is no number with this unit."""
        text = text.strip()
        if text and text == self.specialValueText():
            return self.minimum()
        number = typed_number(text, self._unit, self._factor)
        return None if number is None else number / self._factor

    def _problem(self, text: str | None = None) -> str:
        """Return why what is typed cannot be used; empty if it can."""
        text = self.text() if text is None else text
        value = self._parse(text)
        lowest, highest = (f"{round(end, self.decimals()):.12g}" for end in (self.minimum(), self.maximum()))
        allowed = f"{lowest} ... {highest} {self._unit}".strip()
        about = f"{self._name} {text.strip()}".strip()
        if value is None:
            return f"{about}: type a number {f'in {self._unit}, ' if self._unit else ''}{allowed}"
        if not self.decimals() and value != round(value):
            return f"{about}: only whole numbers {allowed} are allowed"
        rounding = 0.5001 * 10.0 ** -self.decimals()
        if not self.minimum() - rounding <= value <= self.maximum() + rounding:
            return f"{about} is outside the allowed range {allowed}: not changed"
        return ""

    def _restore(self) -> None:
        if (line := self.lineEdit()) is not None:
            word = self.specialValueText() if self.value() == self.minimum() else ""
            line.setText(word or self.textFromValue(self.value()))
        if self._latest is not None:
            self.show_value(*self._latest)

    def _mark(self, _: str = "") -> None:
        """Show in red what would be refused, and say why."""
        problem = self._problem()
        if problem != self._shown_problem:
            self._shown_problem = problem
            mark_refused(self, is_refused=bool(problem))
            self.refused.emit(problem)

    def _enter(self, value: float) -> None:
        """Emit the entered value; rounding to the shown decimals must not leave the range."""
        self.entered.emit(self._allowed.nearest(value * self._factor))


class TextField(QLineEdit):
    """Emits a changed text when it is left, by Return, Esc or a click elsewhere; only a click enters it."""

    entered = pyqtSignal(str)

    def __init__(self, *, tool_tip: str, hint: str) -> None:
        super().__init__()
        self._in_force = ""
        self.setFocusPolicy(Qt.FocusPolicy.ClickFocus)
        self.setToolTip(tool_tip)
        self.setPlaceholderText(hint)
        self.setAccessibleName(hint)

    def show_text(self, text: str) -> None:
        self._in_force = text
        self.setText(text)

    def event(self, event: QEvent | None) -> bool:
        """Keep Return and Esc from the shortcuts, as Qt does with letters."""
        ends = (Qt.Key.Key_Escape, *ENTER)
        if isinstance(event, QKeyEvent) and event.type() == QEvent.Type.KeyPress and event.key() in ends:
            self.clearFocus()
            return True
        return keeps_key(event, *ends) or super().event(event)

    def focusInEvent(self, event: QFocusEvent | None) -> None:  # noqa: N802 - Qt's name
        super().focusInEvent(event)
        if (application := QApplication.instance()) is not None:
            application.installEventFilter(self)

    def eventFilter(self, on: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        """Leave the field when anything else is clicked: keys are shortcuts again."""
        is_click = event is not None and event.type() == QEvent.Type.MouseButtonPress
        if is_click and isinstance(on, QWidget) and on is not self and on.window() is self.window():
            self.clearFocus()
        return False

    def focusOutEvent(self, event: QFocusEvent | None) -> None:  # noqa: N802 - Qt's name
        super().focusOutEvent(event)
        if (application := QApplication.instance()) is not None:
            application.removeEventFilter(self)
        if self.text() != self._in_force:
            self._in_force = self.text()
            self.entered.emit(self._in_force)
