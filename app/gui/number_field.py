"""Number field that leaves letters and the space bar to the window's shortcuts."""

from PyQt6.QtCore import QEvent, Qt, pyqtSignal
from PyQt6.QtGui import QKeyEvent
from PyQt6.QtWidgets import QAbstractSpinBox, QDoubleSpinBox, QWidget

from drivers.interface import Range

_BUTTONS_WIDTH = 26  # px, with the frame
_ENTER = (Qt.Key.Key_Return, Qt.Key.Key_Enter)


class NumberField(QDoubleSpinBox):
    """Shows a value in a convenient unit and emits it in SI units when the user enters it."""

    entered = pyqtSignal(float)

    def __init__(
        self,
        *,
        tool_tip: str,
        unit: float = 1.0,
        suffix: str = "",
        decimals: int = 0,
        lowest: str = "",
        parent: QWidget | None = None,
    ) -> None:
        """Show values in `unit`, e.g. 1e-3 with the suffix " ms", and the lowest value as the word `lowest`."""
        super().__init__(parent)
        self._unit, self._allowed = unit, Range(0, 0)
        self.setSuffix(suffix)
        self.setDecimals(decimals)
        self.setSpecialValueText(lowest)
        self.setToolTip(tool_tip)
        self.setKeyboardTracking(False)
        self.setCorrectionMode(QAbstractSpinBox.CorrectionMode.CorrectToNearestValue)
        if decimals:
            self.setStepType(QAbstractSpinBox.StepType.AdaptiveDecimalStepType)
        usual = max((f"{0:.{decimals}f}".rjust(decimals + 5, "0") + suffix, lowest), key=len)
        self.setMinimumWidth(self.fontMetrics().horizontalAdvance(usual) + _BUTTONS_WIDTH)  # independent of the range
        self.valueChanged.connect(self._enter)

    def show_value(self, value: float, allowed: Range) -> None:
        """Show a value and set the allowed range, both in SI units, without emitting."""
        self._allowed = allowed
        self.blockSignals(True)
        self.setRange(allowed.minimum / self._unit, allowed.maximum / self._unit)
        self.setValue(value / self._unit)
        self.blockSignals(False)

    def edit(self) -> None:
        """Take the focus and select the value, so that typing replaces it."""
        self.setFocus()
        self.selectAll()

    def event(self, event: QEvent | None) -> bool:
        """Pass letters and Space to the shortcuts; keep Return and Esc while the field is edited."""
        if not isinstance(event, QKeyEvent):
            return super().event(event)
        key, is_edited = event.key(), (line := self.lineEdit()) is not None and line.isModified()
        if event.type() == QEvent.Type.ShortcutOverride:
            if event.text().isalpha() or key == Qt.Key.Key_Space:
                event.ignore()
                return False
            if is_edited and key in {*_ENTER, Qt.Key.Key_Escape}:
                event.accept()
                return True
        elif event.type() == QEvent.Type.KeyPress and is_edited and key in {*_ENTER, Qt.Key.Key_Escape}:
            if key == Qt.Key.Key_Escape and line is not None:
                line.setText(self.textFromValue(self.value()))
            self.clearFocus()  # emits the value; digits are shortcuts again
            return True
        return super().event(event)

    def _enter(self, value: float) -> None:
        """Emit the entered value; rounding to the shown decimals must not leave the range."""
        self.entered.emit(min(max(value * self._unit, self._allowed.minimum), self._allowed.maximum))
