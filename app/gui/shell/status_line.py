"""The status line: rate, delay, losses, valid lenslets, and what is assumed of the sample."""

import time
from collections import deque
from statistics import median

import numpy as np
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QLabel, QWidget

from app.acquisition.instrument import Status
from app.gui.panels.panel import Verdict
from app.gui.shell.status_text import as_sentence
from app.gui.widgets import theme
from app.gui.widgets.layouts import row, row_of
from app.gui.widgets.presentation import NOTHING
from app.gui.widgets.texts import ElidedLabel, colour_text, label
from app.measurement.measurement import Measurement, RefinementState, sample_sentence
from reconstruction.displacement import Displacement
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.settings import FIELD_MODES
from reconstruction.wavefront import Wavefront

_RATE = "Frames acquired per second"
_VALID = "Lenslets whose subimage matches the reference"
_RANGE = "; at 100 % light reaches the edge of its cell"  # of the dynamic range
_CORRECTION = "Age of the correction of systematic errors by the model of the bench"
_ASSUMED = "What is assumed of the sample, and what the mask shows"
_LIMITS = "Whether the newest frame is within the limits of the history (View > Limits of the history)"
_LOST = "Frames that the camera overwrote before they were read; red while they become more"
_DELAY = "Processing delay: from the end of the exposure to the result, median over the last second"
_OLD_S = 30.0  # age of a correction; the next one takes some seconds at most
_WINDOW_S = 1.0  # over which rate and delay are taken
_GAP_PX = 14  # between two parts


class StatusLine(QWidget):
    """Shows each value beside its name."""

    def __init__(self) -> None:
        super().__init__()
        self._newest: Measurement | None = None
        self._recent: deque[tuple[float, int, float, int]] = deque()  # time, frames acquired, delay, frames lost
        self.shown = 0
        self.simulated = label("SIMULATED", "badge")
        self.simulated.setToolTip("No real device: camera, light and sample are computed")
        self.simulated.hide()
        self.rate, self.delay = _Value(_RATE, "00.0"), _Value(_DELAY, "0000.0 ms")
        self.lost, self.valid = _Value(_LOST, "000"), _Value(_VALID, "000 of 000")
        self.correction, self.limits = _Value(_CORRECTION, "computing"), _Value(_LIMITS, "pass")
        self.devices = _Value("", "stopped")
        names = "frames/s", "delay", "lost", "valid", "correction", "limits"
        values = self.rate, self.delay, self.lost, self.valid, self.correction, self.limits
        named = [row_of(label(name, "dim"), value) for name, value in zip(names, values, strict=True)]
        for of_value, value in zip(named, values, strict=True):
            of_value.setToolTip(value.about)
        self._of_correction, self._of_limits = named[-2:]
        self.assumed = ElidedLabel("dim")
        line = row(*named, (self.assumed, 1), self.simulated, self.devices, spacing=_GAP_PX, parent=self)
        line.setContentsMargins(10, 0, 10, 2)
        self.restart()
        self.show_verdict(Verdict())

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
        self.simulated.hide()
        self._show_valid(None)
        self._show_correction(RefinementState("off"))
        self.assumed.setText("")

    def update_text(self, status: Status | None, processes: str = "", *, trouble: str = "") -> None:
        """Update the numbers; `processes` tells the state of each one, and `trouble` which is not alive."""
        names: tuple[str, ...] = ()
        if status is not None:
            self.simulated.setVisible(status.bench.is_simulated)
            names = status.camera_name, status.light_name
        if status is not None or trouble:
            state = trouble or ("running" if status is not None and status.is_running else "stopped")
            about = "\n".join(filter(None, [*names, processes]))
            self.devices.show_text(state, about, theme.RED if trouble else theme.DIM)
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
        self._show_valid(None if last.wavefront is None else last.wavefront.displacement)
        self._show_assumed(last, "" if status is None else status.mask_note)
        self._show_correction(last.assumed.refinement)

    def show_verdict(self, verdict: Verdict) -> None:
        """Show whether the newest frame is within the limits, if there are any."""
        self._of_limits.setVisible(bool(verdict.text))
        colour = {"pass": theme.GREEN, "fail": theme.RED}.get(verdict.text, theme.TEXT)
        self.limits.show_text(verdict.text, verdict.reason, colour)

    def _show_valid(self, displacement: Displacement | None) -> None:
        text, about, colour = NOTHING, "", theme.TEXT
        if displacement is not None:
            valid, count = np.count_nonzero(displacement.valid), displacement.valid.size
            text = f"{valid} of {count}"
            about = "\n".join(displacement.summary) + _RANGE
            if valid < count:
                colour = theme.AMBER if valid >= count / 2 else theme.RED
        self.valid.show_text(text, about, colour)

    def _show_assumed(self, measurement: Measurement, mask_note: str) -> None:
        sample, told, fitted = measurement.assumed.sample, "", ""
        if measurement.wavefront is not None:
            fitted = _fitted(measurement.wavefront)
            told = f"Sample: {sample_sentence(sample or FREE, measurement.wavefront.field)}"
            told += " (searching for layers)" * (sample is None)
        told = told.replace("+-", "\N{PLUS-MINUS SIGN}")
        self.assumed.setText(told)
        self.assumed.setToolTip(
            "".join(f"<p>{as_sentence(one)}.</p>" for one in (_ASSUMED, told, fitted, mask_note) if one)
        )

    def _show_correction(self, refinement: RefinementState) -> None:
        change = f"The wavefront has changed by {refinement.moved_rad:.2f} rad RMS since the correction was computed"
        by_age = theme.AMBER if refinement.age_s > _OLD_S else theme.GREEN
        text, why, colour = {
            "off": ("off", "", theme.TEXT),
            "preparing": ("computing", "", theme.TEXT),
            "applied": (f"{refinement.age_s:.1f} s old", change, by_age),
            "moved": ("rejected", f"{change}: too much to apply it", theme.AMBER),
            "worse": ("rejected", "It brings the model no closer to the measurement", theme.AMBER),
            "failed": ("failed", refinement.problem, theme.RED),
        }[refinement.stage]
        self._of_correction.setVisible(refinement.stage != "off")
        self.correction.show_text(text, why, colour)


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


def _fitted(wavefront: Wavefront) -> str:
    """Name the warp and the number of pupil modes, also those chosen automatically."""
    warps = {count: f"warp {name}" for name, count in FIELD_MODES.items()}
    modes = "" if wavefront.coefficients is None else f"{len(wavefront.coefficients)} pupil modes"
    return "fitted: " + ", ".join(filter(None, [warps.get(wavefront.displacement.modes.count), modes]))


def _duration(seconds: float) -> str:
    return f"{seconds * 1e3:.1f} ms" if seconds < 1 else f"{seconds:.1f} s"
