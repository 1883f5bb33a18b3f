"""A line of text that the window's shortcuts leave alone while it is edited."""

from PyQt6.QtCore import QEvent, QObject, Qt, pyqtSignal
from PyQt6.QtGui import QFocusEvent, QKeyEvent
from PyQt6.QtWidgets import QApplication, QLineEdit, QWidget

from app.gui.widgets import ENTER


class TextField(QLineEdit):
    """Emits a changed text when the user enters it; Return enters, Esc restores, and both leave the field.

    Keys are typed into it only after a click: Tab does not reach it, and a click anywhere else leaves it.
    """

    entered = pyqtSignal(str)

    def __init__(self, *, tool_tip: str, hint: str, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._in_force = ""
        self.setFocusPolicy(Qt.FocusPolicy.ClickFocus)
        self.setToolTip(tool_tip)
        self.setPlaceholderText(hint)

    def show_text(self, text: str) -> None:
        """Show a text without emitting it."""
        self._in_force = text
        self.setText(text)

    def event(self, event: QEvent | None) -> bool:
        """Keep Return and Esc from the shortcuts; Qt does that for letters."""
        if isinstance(event, QKeyEvent) and (event.key() == Qt.Key.Key_Escape or event.key() in ENTER):
            if event.type() == QEvent.Type.ShortcutOverride:
                event.accept()
                return True
            if event.type() == QEvent.Type.KeyPress:
                if event.key() == Qt.Key.Key_Escape:
                    self.setText(self._in_force)
                self.clearFocus()
                return True
        return super().event(event)

    def focusInEvent(self, event: QFocusEvent | None) -> None:  # noqa: N802 - Qt's name
        """Watch for clicks elsewhere."""
        super().focusInEvent(event)
        if (application := QApplication.instance()) is not None:
            application.installEventFilter(self)

    def eventFilter(self, on: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        """Leave the field when anything else is clicked, also what takes no focus: keys are shortcuts again."""
        is_click = event is not None and event.type() == QEvent.Type.MouseButtonPress
        if is_click and isinstance(on, QWidget) and on is not self and on.window() is self.window():
            self.clearFocus()
        return False

    def focusOutEvent(self, event: QFocusEvent | None) -> None:  # noqa: N802 - Qt's name
        """Enter the text."""
        super().focusOutEvent(event)
        if (application := QApplication.instance()) is not None:
            application.removeEventFilter(self)
        if self.text() != self._in_force:
            self._in_force = self.text()
            self.entered.emit(self._in_force)
