"""Main window that keeps the focus, so that every key is a shortcut until a field is clicked, and times painting."""

import time

from PyQt6.QtCore import QEvent
from PyQt6.QtWidgets import QMainWindow

from app.measurement.measurement import Measurement
from app.timing import Timings


class BaseWindow(QMainWindow):
    """Takes the focus when it becomes active, and from a widget that is hidden or disabled.

    Qt would give it to the first button or field in the Tab order.
    """

    unpainted: tuple[Measurement, Timings, float] | None = None  # with the seconds of drawing so far

    def event(self, event: QEvent | None) -> bool:
        """Take the focus when active, and time the painting, which Qt does for the whole window at UpdateRequest."""
        if event is not None and event.type() == QEvent.Type.WindowActivate:
            self.setFocus()
        if event is None or event.type() != QEvent.Type.UpdateRequest or self.unpainted is None:
            return super().event(event)
        (measurement, timings, seconds), self.unpainted = self.unpainted, None
        start_s = time.perf_counter()
        is_handled = super().event(event)
        end_s = time.perf_counter()
        timings.note("draw", seconds + end_s - start_s)
        timings.note("to_screen", end_s - measurement.exposure_end_s)
        return is_handled

    def focusNextPrevChild(self, next: bool) -> bool:  # noqa: A002, N802 - Qt's names
        """Move the focus as Tab does, unless its widget has just been hidden or disabled."""
        focused = self.focusWidget()
        if focused is not None and not (focused.isVisible() and focused.isEnabled()):
            self.setFocus()
            return True
        return super().focusNextPrevChild(next)
