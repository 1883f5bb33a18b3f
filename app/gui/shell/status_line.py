"""The status line: rate, delay, losses, and the state of the devices."""

import time
from collections import deque
from statistics import median

from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QLabel, QWidget

from app.acquisition.instrument import Status
from app.gui.widgets import theme
from app.gui.widgets.layouts import row, row_of
from app.gui.widgets.presentation import NOTHING
from app.gui.widgets.texts import colour_text, label
from app.measurement.measurement import Measurement

_RATE = "Frames acquired per second"
_LOST = "Frames that the camera overwrote before they were read; red while the count increases"
_DELAY = "Processing delay: from the end of the exposure to the result, median over the last second"
_WINDOW_S = 1.0  # over which rate and delay are taken
_GAP_PX = 14  # between two parts


class StatusLine(QWidget):
    """Shows each value next to its name."""

    def __init__(self) -> None:
        super().__init__()
        self._newest: Measurement | None = None
        self._recent: deque[tuple[float, int, float, int]] = deque()  # time, frames acquired, delay, frames lost
        self.shown = 0
        self.rate, self.delay, self.lost = _Value(_RATE, "00.0"), _Value(_DELAY, "000.0 ms"), _Value(_LOST, "00")
        self.devices = _Value("", "stopped")
        values = {"frames/s": self.rate, "delay": self.delay, "lost": self.lost}
        self._named = [row_of(label(name, "dim"), value) for name, value in values.items()]
        for of_value, value in zip(self._named, values.values(), strict=True):
            of_value.setToolTip(value.about)
        row(*self._named, self.devices, spacing=_GAP_PX, parent=self).setContentsMargins(0, 0, 10, 0)
        self.restart()

    def count(self, measurement: Measurement) -> None:
        self.shown += 1
        self._newest, time_s = measurement, measurement.frame.host_time_s
        counts = measurement.counts
        self._recent.append((time_s, counts.acquired, measurement.latency_s, counts.lost))
        while self._recent[0][0] < time_s - _WINDOW_S and len(self._recent) > 2:
            self._recent.popleft()

    def restart(self) -> None:
        self._newest = None
        self._recent.clear()
        self.shown = 0
        for value, text in ((self.rate, NOTHING), (self.delay, NOTHING), (self.lost, "0"), (self.devices, "")):
            value.show_text(text)

    def update_text(self, status: Status | None, processes: str = "", *, trouble: str = "") -> None:
        """Update the numbers; `processes` has the state of each, and `trouble` which is not alive."""
        if status is not None or trouble:
            state = trouble or ("running" if status is not None and status.is_running else "stopped")
            names = () if status is None else (status.camera_name, status.light_name)
            about = "\n".join(filter(None, [*names, processes]))
            self.devices.show_text(state, about, theme.RED if trouble else theme.DIM)
            for value in self._named:
                value.setVisible(not trouble)  # the message needs the space
        last = self._newest
        if last is None:
            return
        (first_s, first_count, _, first_lost), (last_s, last_count, _, lost) = self._recent[0], self._recent[-1]
        if status is not None and status.is_replay:
            self.lost.show_text(str(lost), "In a replay, those that were lost when it was recorded")
        else:
            self.lost.show_text(str(lost), colour=theme.RED if lost > first_lost else theme.TEXT)
        is_running = status is not None and status.is_running
        has_rate = is_running and last_s > first_s
        rate = f"{(last_count - first_count) / (last_s - first_s):.1f}" if has_rate else NOTHING
        age = _duration(time.perf_counter() - last.exposure_end_s)
        counts = f"{last.counts.acquired} acquired, {last.counts.reconstructed} reconstructed, {self.shown} shown"
        self.rate.show_text(rate, f"{counts} in this window; the shown one is {age} old")
        self.delay.show_text(_duration(median(delay_s for _, _, delay_s, _ in self._recent)))


class _Value(QLabel):
    """A short text with a tool tip: what it is about, and more of it."""

    def __init__(self, about: str, widest: str) -> None:
        super().__init__()
        self.about, self._more = about, ""
        self.setMinimumWidth(self.fontMetrics().horizontalAdvance(widest))  # so that the next does not move

    def show_text(self, text: str, more: str = "", colour: QColor = theme.TEXT) -> None:
        """Show a text in a fixed size that never shrinks, else Qt lays out and paints all values."""
        if text != self.text():
            self.setText(text)
            needed = self.sizeHint()
            self.setFixedSize(max(self.minimumWidth(), needed.width()), needed.height())
        if more != self._more:
            self._more = more
            self.setToolTip("\n".join(filter(None, [self.about, more])))
        colour_text(self, colour)


def _duration(seconds: float) -> str:
    return f"{seconds * 1e3:.1f} ms" if seconds < 1 else f"{seconds:.1f} s"
