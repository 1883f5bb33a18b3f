"""The line at the bottom: what has become of the frames, how fast, and how old they are when they are shown."""

from __future__ import annotations

import time
from collections import deque
from statistics import median

import numpy as np
from PyQt6.QtWidgets import QHBoxLayout, QVBoxLayout, QWidget

from app.acquisition.instrument import Status
from app.acquisition.worker import Measurement
from app.gui import theme
from app.gui.fitting_row import FittingRow
from app.gui.reasons import REASONS
from app.gui.timing_row import Summaries, TimingRow, timing_table
from app.gui.widgets import label
from app.measurement.live_refinement import RefinementState
from reconstruction.displacement import Displacement

_VALID = "Lenslets whose subimage could be matched with the reference"
_REFINED = "Whether the wavefront is corrected by the bias that a forward model found, and how long ago"
_LATENCY = "From the end of the exposure to the result, median over the last second"
_SHOWN = "Frames drawn here: the newest one, up to 25 times a second"
_WINDOW_S = 1.0  # over which rate and latency are taken


class StatusLine(QWidget):
    """Counts, rate and latency, each beside its name."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._recent: deque[Measurement] = deque()
        self.shown = 0
        self.timing_row = TimingRow()
        self.row = row = FittingRow()
        self.devices = label("", "dim")
        line = QHBoxLayout()
        line.addWidget(row, 1)
        line.addWidget(self.devices)
        both = QVBoxLayout(self)
        both.setContentsMargins(10, 0, 10, 2)
        both.setSpacing(2)
        both.addWidget(self.timing_row)
        both.addLayout(line)
        count, time_s = "00000", "0000.0 ms"
        self.acquired = row.add("acquired", "Frames read from the camera", widest=count, importance=7)
        self.reconstructed = row.add("reconstructed", "Frames that yielded a wavefront", widest=count, importance=6)
        self.shown_count = row.add("shown", _SHOWN, widest=count, importance=8)
        self.lost = row.add("lost", "Frames that the camera overwrote before they were read", widest="0", importance=2)
        self.rate = row.add("frames/s", "Frames acquired per second", widest="00.0", importance=1)
        self.latency = row.add("latency", _LATENCY, widest=time_s, importance=4)
        self.age = row.add("age", "How long ago the frame that is shown was exposed", widest=time_s, importance=5)
        self.valid = row.add("valid", _VALID, widest="000 of 000", importance=0)
        self.refined = row.add("refined", _REFINED, widest="preparing", importance=3)

    def count(self, measurement: Measurement) -> None:
        """Take note that a measurement is shown."""
        self.shown += 1
        self._recent.append(measurement)
        oldest_s = measurement.frame.host_time_s - _WINDOW_S
        while self._recent[0].frame.host_time_s < oldest_s and len(self._recent) > 2:
            self._recent.popleft()

    def restart(self) -> None:
        """Forget the frames of the acquisition before."""
        self._recent.clear()
        self.shown = 0

    def update_text(self, status: Status | None, timings: Summaries | None = None) -> None:
        """Write the numbers."""
        if timings is not None:
            self.timing_row.update_text(timings)
            self.latency.setToolTip(f"<p>{_LATENCY}.</p>{timing_table(timings)}")
        if status is not None:
            self.devices.setText("running" if status.is_running else "stopped")
            self.devices.setToolTip(f"{status.camera_name}\n{status.light_name}")
        if not self._recent:
            return
        first, last = self._recent[0], self._recent[-1]
        self.acquired.setText(str(last.counts.acquired))
        self.reconstructed.setText(str(last.counts.reconstructed))
        self.lost.setText(str(last.counts.lost))
        self.shown_count.setText(str(self.shown))
        seconds = last.frame.host_time_s - first.frame.host_time_s
        is_running = status is not None and status.is_running
        frames = last.counts.acquired - first.counts.acquired
        self.rate.setText(f"{frames / seconds:.1f}" if is_running and seconds > 0 else "\N{EN DASH}")
        self.latency.setText(_duration(median(one.latency_s for one in self._recent)))
        self.age.setText(_duration(time.perf_counter() - last.exposure_end_s))
        self._show_valid(None if last.wavefront is None else last.wavefront.displacement)
        self._show_refinement(last.refinement)
        self.row.fit()

    def _show_valid(self, displacement: Displacement | None) -> None:
        """Count the valid lenslets; the tool tip tells what has become of the others."""
        text, tool_tip, colour = "\N{EN DASH}", _VALID, theme.TEXT
        if displacement is not None:
            outcomes = displacement.outcome
            valid = np.count_nonzero(displacement.valid)
            text = f"{valid} of {outcomes.size}"
            lost = [(np.count_nonzero(outcomes == outcome), why) for outcome, why in REASONS.items() if why]
            used = 100 * np.nanmax(displacement.range_used, initial=0.0)
            tool_tip = "\n".join(
                [
                    _VALID,
                    *(f"{count} lost: {why}" for count, why in lost if count),
                    f"{used:.0f} % of the dynamic range used: at 100 % light reaches the edge of its cell",
                ]
            )
            if valid < outcomes.size:
                colour = theme.AMBER if valid >= outcomes.size / 2 else theme.RED
        self.valid.setText(text)
        self.valid.setToolTip(tool_tip)
        self.valid.setStyleSheet(f"color: {colour.name()};")

    def _show_refinement(self, refinement: RefinementState) -> None:
        """Say whether the wavefront is refined, and on how old a state; a correction that was dropped is seen."""
        text, why, colour = {
            "off": ("off", "", theme.TEXT),
            "preparing": ("preparing", "", theme.TEXT),
            "applied": (f"{refinement.age_s:.1f} s old", _moved(refinement), theme.GREEN),
            "moved": ("dropped", f"{_moved(refinement)}: too much for the bias found there", theme.AMBER),
            "failed": ("failed", refinement.problem, theme.RED),
        }[refinement.stage]
        self.refined.setText(text)
        self.refined.setToolTip("\n".join(filter(None, [_REFINED, why])))
        self.refined.setStyleSheet(f"color: {colour.name()};")


def _moved(refinement: RefinementState) -> str:
    return f"The wavefront has changed by {refinement.moved_rad:.2f} rad RMS since the bias was found"


def _duration(seconds: float) -> str:
    return f"{seconds * 1e3:.1f} ms" if seconds < 1 else f"{seconds:.1f} s"
