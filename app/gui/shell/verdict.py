"""The verdict on the newest frame: good, or why not, with what is assumed of the sample in its tool tip."""

import numpy as np
from PyQt6.QtCore import pyqtSignal
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QSizePolicy

from app.gui.panels.panel import DisplayState
from app.gui.shell.status_text import as_sentence
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button
from app.gui.widgets.presentation import NOTHING, number, percent
from app.gui.widgets.texts import elided
from app.measurement.measurement import Measurement, RefinementState, sample_sentence
from reconstruction.layers.layered_wavefront import FREE

_OLD_S = 30.0  # age of a correction; the next one takes some seconds at most
_AROUND_PX = 34  # lamp and margins


class VerdictButton(Button):
    """Says whether the newest frame is good; a click names the panel that shows why: "" is the log."""

    cause_requested = pyqtSignal(str)

    def __init__(self, shown: DisplayState) -> None:
        super().__init__("", "")
        self._shown, self.valid, self.cause = shown, NOTHING, ""
        self.clicked.connect(lambda: self.cause_requested.emit(self.cause))
        self.setProperty("role", "verdict")
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)

    def show_verdict(self, problem: str, *, is_failed: bool, is_busy: bool, mask_note: str) -> None:
        """Show a `problem`, that may be a failure or an activity, or else what is known of the newest frame."""
        shown, measurement = self._shown, self._shown.measurement
        wavefront = None if measurement is None else measurement.wavefront
        badge, reason, is_grey = shown.data_freshness
        self.valid, self.cause, lamp, colour = NOTHING, "", "missing", theme.DIM
        word, about = "NO WAVEFRONT" if measurement is not None else "NO FRAME", [f"{badge}: {reason}"] * bool(badge)
        numbers, is_searching = list[str](), badge.startswith("ANOTHER")
        if measurement is not None and shown.statistics is not None:
            numbers.append(percent(shown.statistics.peak / shown.statistics.clip_level))
            about.append(f"Brightest pixel: {numbers[0]} of full scale")
        if measurement is not None and wavefront is not None:
            valid = wavefront.displacement.valid[wavefront.displacement.present]
            self.valid = f"{np.count_nonzero(valid)} of {valid.size}"
            numbers.append(self.valid)
            if shown.sigma_rad is not None:
                numbers.append(f"\N{PLUS-MINUS SIGN} {number(shown.sigma_rad * shown.per_rad, 2)} {shown.unit}")
            word, lamp, colour = "GOOD", "good", theme.GREEN
            if not valid.all():
                self.cause, lamp, colour = "lenslet", "doubtful", theme.AMBER
                word, colour = ("FAIR", theme.AMBER) if valid.mean() >= 0.5 else ("POOR", theme.RED)
            about += [*wavefront.displacement.summary, *_assumed(measurement), mask_note]
            if badge and word == "GOOD":  # green is for a live frame
                word, lamp, colour = badge.partition(" ")[0].rstrip(","), "missing", theme.TEXT
        if shown.verdict.text:
            about.append(shown.verdict.reason)
        if shown.verdict.text == "fail":
            word, self.cause, lamp, colour = "BEYOND LIMITS", "history", "doubtful", theme.RED
        if problem or is_grey or is_searching:
            word = "FAILED" if is_failed else "BUSY" if is_busy else "BAD" if problem else badge
            numbers = [problem or reason]
            lamp = "missing" if is_busy else "doubtful"
            colour = theme.RED if is_failed else theme.DIM if is_busy else theme.AMBER
            self.cause = "histogram" if "saturated" in problem else self.cause
        self._show(word, ", ".join(filter(None, numbers)), lamp, colour)
        self.setToolTip(
            "".join(f"<p>{as_sentence(one)}</p>" for one in (f"{word}: {', '.join(numbers)}", *about) if one)
        )

    def _show(self, word: str, numbers: str, lamp: str, colour: QColor) -> None:
        text = elided(f"{word} {numbers}", self.fontMetrics(), self.width() - _AROUND_PX)
        if text != self.text() or self.accessibleName() != f"{word} {numbers}":
            self.setText(text)
            self.setAccessibleName(f"{word} {numbers}")
            self.setIcon(theme.validity_lamp(lamp))
            theme.restyle(self, "tone", theme.tone(colour))


def _assumed(measurement: Measurement) -> list[str]:
    """Say what is assumed of the sample, and how old the correction of systematic errors is."""
    assumed, wavefront = measurement.assumed, measurement.wavefront
    if wavefront is None:
        return []
    sample = sample_sentence(assumed.sample or FREE, wavefront.field) + " (searching for layers)" * (
        assumed.sample is None
    )
    return [f"Sample: {sample}".replace("+-", "\N{PLUS-MINUS SIGN}"), correction_in_words(assumed.refinement)]


def correction_in_words(refinement: RefinementState) -> str:
    """Say how old the correction of systematic errors is, or why there is none; empty if it is off."""
    changed = f"the wavefront has changed by {refinement.moved_rad:.2f} rad RMS since it was computed"
    old = ", which is old" * (refinement.age_s > _OLD_S)
    return {
        "off": "",
        "preparing": "Correction: computing",
        "applied": f"Correction: {refinement.age_s:.1f} s old{old}; {changed}",
        "moved": f"Correction rejected: {changed}",
        "worse": "Correction rejected: it brings the model no closer to the measurement",
        "failed": f"Correction failed: {refinement.problem}",
    }[refinement.stage]
