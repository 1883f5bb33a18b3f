"""The status line: frame counts, rate, delays and valid lenslets; the least important are hidden when it is narrow."""

import math
import time
from collections import deque
from dataclasses import dataclass
from itertools import accumulate
from statistics import median

import numpy as np
from PyQt6.QtCore import QSize
from PyQt6.QtGui import QResizeEvent
from PyQt6.QtWidgets import QLabel, QSizePolicy, QWidget

from app.acquisition.instrument import Status
from app.acquisition.worker import Measurement
from app.gui import theme
from app.gui.timing_row import TimingRow, timing_table
from app.gui.widgets import colour_text, column, label, row
from app.gui.wording import lenslet_summary
from app.measurement.assumptions import sample_sentence
from app.measurement.live_solver import RefinementState
from app.timing import Timings
from reconstruction.displacement import Displacement
from reconstruction.layers.layered_wavefront import FREE

_VALID = "Lenslets whose subimage matches the reference"
_CORRECTION = "Age of the correction of systematic errors"
_SAMPLE = "What is assumed of the sample; layers are searched for in the background"
_LAYERS = ("any", "1 layer", "2 layers")
_DELAY = "Processing delay: from the end of the exposure to the result, median over the last second"
_SHOWN = "Frames drawn in this window: the newest one, up to 25 times a second"
_WINDOW_S = 1.0  # over which rate and delay are taken
_TIMES_INTERVAL_S = 1.0  # the percentiles of thousands of times take a millisecond
_GAP = 14  # px between two parts
_WITHIN = 4  # px between a name and its value


class StatusLine(QWidget):
    """Shows each value beside its name."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._newest: Measurement | None = None
        self._recent: deque[tuple[float, int, float]] = deque()  # time, frames acquired, delay: measurements are large
        self.shown = 0
        self._times_due_s = -math.inf
        self.timing_row = TimingRow()
        self.row = line = FittingRow()
        self.devices = label("", "dim")
        self.simulated = label("SIMULATED", "badge")
        self.simulated.setToolTip("No real device: camera, light and sample are computed")
        self.simulated.hide()
        column(
            self.timing_row, row((line, 1), self.simulated, self.devices), spacing=2, parent=self
        ).setContentsMargins(10, 0, 10, 2)
        count, time_s = "00000", "0000.0 ms"
        self.acquired = line.add("acquired", "Frames read from the camera", widest=count, importance=8)
        self.reconstructed = line.add("reconstructed", "Frames with a wavefront", widest=count, importance=7)
        self.shown_count = line.add("shown", _SHOWN, widest=count, importance=9)
        self.lost = line.add("lost", "Frames that the camera overwrote before they were read", widest="0", importance=2)
        self.rate = line.add("frames/s", "Frames acquired per second", widest="00.0", importance=1)
        self.delay = line.add("delay", _DELAY, widest=time_s, importance=5)
        self.age = line.add("frame age", "Time since the exposure of the shown frame", widest=time_s, importance=6)
        self.valid = line.add("valid", _VALID, widest="000 of 000", importance=0)
        self.sample = line.add("sample", _SAMPLE, widest="searching", importance=4)
        self.correction = line.add("correction", _CORRECTION, widest="computing", importance=3)

    def count(self, measurement: Measurement) -> None:
        """Count a shown measurement."""
        self.shown += 1
        self._newest, time_s = measurement, measurement.frame.host_time_s
        self._recent.append((time_s, measurement.counts.acquired, measurement.latency_s))
        while self._recent[0][0] < time_s - _WINDOW_S and len(self._recent) > 2:
            self._recent.popleft()

    def restart(self) -> None:
        """Forget the frames of the previous acquisition."""
        self._newest = None
        self._recent.clear()
        self.shown = 0

    def update_text(self, status: Status | None, timings: Timings | None) -> None:
        """Update the numbers, those of the tool tip once a second."""
        if timings is not None and (time.monotonic() > self._times_due_s or self.timing_row.isVisible()):
            self._times_due_s = time.monotonic() + _TIMES_INTERVAL_S
            summary = timings.summary()
            self.timing_row.update_text(summary)
            self.delay.setToolTip(f"<p>{_DELAY}.</p>{timing_table(summary)}")
        if status is not None:
            self.simulated.setVisible(status.bench.is_simulated)
            self.devices.setText("running" if status.is_running else "stopped")
            self.devices.setToolTip(f"{status.camera_name}\n{status.light_name}")
        last = self._newest
        if last is None:
            return
        self.acquired.setText(str(last.counts.acquired))
        self.reconstructed.setText(str(last.counts.reconstructed))
        self.lost.setText(str(last.counts.lost))
        self.shown_count.setText(str(self.shown))
        (first_s, first_count, _), (last_s, last_count, _) = self._recent[0], self._recent[-1]
        is_running = status is not None and status.is_running
        has_rate = is_running and last_s > first_s
        self.rate.setText(f"{(last_count - first_count) / (last_s - first_s):.1f}" if has_rate else "\N{EN DASH}")
        self.delay.setText(_duration(median(delay_s for _, _, delay_s in self._recent)))
        self.age.setText(_duration(time.perf_counter() - last.exposure_end_s))
        self._show_valid(None if last.wavefront is None else last.wavefront.displacement)
        self._show_sample(last, "" if status is None else status.mask_note)
        self._show_correction(last.assumed.refinement)
        self.row.fit()

    def _show_valid(self, displacement: Displacement | None) -> None:
        text, tool_tip, colour = "\N{EN DASH}", _VALID, theme.TEXT
        if displacement is not None:
            valid, count = np.count_nonzero(displacement.valid), displacement.valid.size
            text = f"{valid} of {count}"
            tool_tip = "\n".join([_VALID, *lenslet_summary(displacement)])
            if valid < count:
                colour = theme.AMBER if valid >= count / 2 else theme.RED
        self.valid.setText(text)
        self.valid.setToolTip(tool_tip)
        colour_text(self.valid, colour)

    def _show_sample(self, measurement: Measurement, mask_note: str) -> None:
        sample, text, told = measurement.assumed.sample, "\N{EN DASH}", ""
        if measurement.wavefront is not None:
            text = "searching" if sample is None else _LAYERS[len(sample.ratios)]
            told = f"Assumed: {sample_sentence(sample or FREE, measurement.wavefront.field)}"
        self.sample.setText(text)
        self.sample.setToolTip("\n".join(filter(None, [_SAMPLE, told, mask_note])))

    def _show_correction(self, refinement: RefinementState) -> None:
        change = f"The wavefront has changed by {refinement.moved_rad:.2f} rad RMS since the correction was computed"
        text, why, colour = {
            "off": ("off", "", theme.TEXT),
            "preparing": ("computing", "", theme.TEXT),
            "applied": (f"{refinement.age_s:.1f} s old", change, theme.GREEN),
            "moved": ("rejected", f"{change}: too much to apply it", theme.AMBER),
            "worse": ("rejected", "It brings the model no closer to the measurement", theme.AMBER),
            "failed": ("failed", refinement.problem, theme.RED),
        }[refinement.stage]
        self.correction.setText(text)
        self.correction.setToolTip("\n".join(filter(None, [_CORRECTION, why])))
        colour_text(self.correction, colour)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    name: str
    importance: int  # 0 is hidden last
    shown: QWidget  # holds name and value
    value: QLabel


class FittingRow(QWidget):
    """A row of names and values without minimum width; an ellipsis with a tool tip replaces hidden ones."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._parts: list[_Part] = []
        self._more = label("\N{HORIZONTAL ELLIPSIS}", "dim")
        self._row = row(self._more, spacing=_GAP, parent=self)
        self._row.addStretch()
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)

    def add(self, name: str, tool_tip: str, *, widest: str, importance: int) -> QLabel:
        """Add a value with room for the `widest` usual text; the highest `importance` is hidden first."""
        value = label("\N{EN DASH}")
        value.setMinimumWidth(value.fontMetrics().horizontalAdvance(widest))
        shown = QWidget()
        row(label(name, "dim"), value, spacing=_WITHIN, parent=shown)
        shown.setToolTip(tool_tip)
        value.setToolTip(tool_tip)
        self._row.insertWidget(len(self._parts), shown)
        self._parts.append(_Part(name, importance, shown, value))
        return value

    @property
    def hidden_names(self) -> tuple[str, ...]:
        """Names of the hidden values."""
        return tuple(part.name for part in self._parts if part.shown.isHidden())

    def fit(self) -> None:
        """Show the values that fit; the room of a value never shrinks.

        Each value has a fixed size; otherwise Qt lays out and paints the whole status bar for each new text.
        """
        for part in self._parts:
            needed = part.value.sizeHint()
            part.value.setFixedSize(max(part.value.minimumWidth(), needed.width()), needed.height())
        whole = "\n".join(f"{part.name} {part.value.text()}" for part in self._parts)
        for widget in (self, self._more):
            widget.setToolTip(whole)
        width, wanted = self.width(), sum(map(_width, self._parts))
        left = width if wanted <= width else width - self._more.sizeHint().width() - _GAP
        by_importance = sorted(self._parts, key=lambda part: part.importance)
        count = sum(used <= left for used in accumulate(map(_width, by_importance)))
        for index, part in enumerate(by_importance):
            part.shown.setVisible(index < count)
            if self.width() != width:  # the layout resized the row, which was fitted again
                return
        self._more.setVisible(count < len(self._parts))

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return a minimum width of zero."""
        return QSize(0, super().minimumSizeHint().height())

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802 - Qt's name
        """Fit the values to the new width."""
        super().resizeEvent(event)
        self.fit()


def _width(part: _Part) -> int:
    return part.shown.sizeHint().width() + _GAP


def _duration(seconds: float) -> str:
    return f"{seconds * 1e3:.1f} ms" if seconds < 1 else f"{seconds:.1f} s"
