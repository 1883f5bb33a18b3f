"""A window that knows how long it takes to draw, painting included."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from PyQt6.QtCore import QEvent
from PyQt6.QtWidgets import QMainWindow

from app.acquisition.worker import Measurement
from app.timing import Timings


class TimedWindow(QMainWindow):
    """Notes how long measurements take to be shown, and how old they are when they have been painted."""

    def __init__(self) -> None:
        super().__init__()
        self._unpainted: tuple[Measurement, Timings, float] | None = None  # the last number: seconds so far

    @contextmanager
    def drawing(self, measurement: Measurement, timings: Timings) -> Iterator[None]:
        """Show a measurement in the body of a `with`; what changes is painted afterwards, when Qt finds the time."""
        start_s = time.perf_counter()
        yield
        self._unpainted = measurement, timings, time.perf_counter() - start_s

    def event(self, event: QEvent | None) -> bool:
        """Qt paints whatever has changed in all of the window at this one event."""
        if event is None or event.type() != QEvent.Type.UpdateRequest or self._unpainted is None:
            return super().event(event)
        (measurement, timings, seconds), self._unpainted = self._unpainted, None
        start_s = time.perf_counter()
        is_handled = super().event(event)
        end_s = time.perf_counter()
        timings.note("draw", seconds + end_s - start_s)
        timings.note("to_screen", end_s - measurement.exposure_end_s)
        return is_handled
