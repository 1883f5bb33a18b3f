"""Main window that times its painting."""

import time

from PyQt6.QtCore import QEvent

from app.gui.neutral_focus import NeutralFocusWindow
from app.measurement.measurement import Measurement
from app.timing import Timings


class TimedWindow(NeutralFocusWindow):
    """Notes how long a measurement takes to be drawn, and from its exposure to the screen."""

    def __init__(self) -> None:
        super().__init__()
        self.unpainted: tuple[Measurement, Timings, float] | None = None  # with the seconds of drawing so far

    def event(self, event: QEvent | None) -> bool:
        """Time the painting, which Qt does for the whole window at its event UpdateRequest."""
        if event is None or event.type() != QEvent.Type.UpdateRequest or self.unpainted is None:
            return super().event(event)
        (measurement, timings, seconds), self.unpainted = self.unpainted, None
        start_s = time.perf_counter()
        is_handled = super().event(event)
        end_s = time.perf_counter()
        timings.note("draw", seconds + end_s - start_s)
        timings.note("to_screen", end_s - measurement.exposure_end_s)
        return is_handled
