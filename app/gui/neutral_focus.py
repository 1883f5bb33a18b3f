"""Main window that keeps the focus itself, so that every key is a shortcut until a field is clicked."""

from PyQt6.QtCore import QEvent
from PyQt6.QtWidgets import QMainWindow


class NeutralFocusWindow(QMainWindow):
    """Takes the focus when it becomes active, and from a widget that is hidden or disabled.

    Qt would give it to the first button or field in the Tab order.
    """

    def event(self, event: QEvent | None) -> bool:
        """Take the focus when the window becomes active."""
        if event is not None and event.type() == QEvent.Type.WindowActivate:
            self.setFocus()
        return super().event(event)

    def focusNextPrevChild(self, next: bool) -> bool:  # noqa: A002, N802 - Qt's names
        """Move the focus as Tab does, unless its widget has just been hidden or disabled."""
        focused = self.focusWidget()
        if focused is not None and not (focused.isVisible() and focused.isEnabled()):
            self.setFocus()
            return True
        return super().focusNextPrevChild(next)
