"""What each stage of the live path takes: a row that a key brings up, and the tool tip of the latency."""

from __future__ import annotations

from collections.abc import Mapping

from PyQt6.QtWidgets import QHBoxLayout, QLabel, QWidget

from app.gui.widgets import label
from app.timing import MEANINGS, STAGES, Stage, Summary

Summaries = Mapping[Stage, Summary]


class TimingRow(QWidget):
    """Median, 99th percentile and maximum of every stage; out of sight until it is asked for."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        layout = QHBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(4)
        layout.addWidget(label("ms: median / 99 % / max", "dim"))
        self.values: dict[Stage, QLabel] = {}
        for stage in STAGES:
            name = label(stage.replace("_", " "), "dim")
            value = self.values[stage] = label("\N{EN DASH}")
            for widget in (name, value):
                widget.setToolTip(f"{stage.replace('_', ' ')}: {MEANINGS[stage]}")
                layout.addWidget(widget)
            layout.addSpacing(6)
        layout.addStretch()
        self.hide()

    def toggle(self) -> None:
        """Bring the row up, or put it away."""
        self.setVisible(self.isHidden())

    def update_text(self, summaries: Summaries) -> None:
        """Write the numbers."""
        for stage, value in self.values.items():
            value.setText(_numbers(summaries[stage]))


def timing_table(summaries: Summaries) -> str:
    """All stages as a table for a tool tip."""
    rows = "".join(
        f"<tr><td>{stage.replace('_', ' ')}&nbsp;</td><td align='right'>{_numbers(summaries[stage])}&nbsp;</td>"
        f"<td>{MEANINGS[stage]}</td></tr>"
        for stage in STAGES
    )
    return f"<table><tr><td></td><td>median / 99 % / max, ms&nbsp;</td><td></td></tr>{rows}</table>"


def _numbers(summary: Summary) -> str:
    """Write a stage's times in ms."""
    if not summary.count:
        return "\N{EN DASH}"
    return " / ".join(f"{seconds * 1e3:.1f}" for seconds in (summary.p50_s, summary.p99_s, summary.max_s))
