"""Processing times of each stage, as a hidden row of the window and as a tool tip."""

from collections.abc import Mapping

from PyQt6.QtCore import Qt
from PyQt6.QtWidgets import QGridLayout, QLabel, QWidget

from app.gui.widgets import label
from app.timing import MEANINGS, STAGES, Stage, StageTimes

Summaries = Mapping[Stage, StageTimes]
_COLUMNS = ("median", "99 %", "max")
_WIDEST = "0000.0"


class TimingRow(QWidget):
    """Median, 99th percentile and maximum of every stage; hidden at first."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 4)
        grid.setHorizontalSpacing(14)
        grid.setVerticalSpacing(0)
        for row, text in enumerate(("ms", *_COLUMNS)):
            grid.addWidget(label(text, "dim"), row, 0)
        self.values: dict[Stage, tuple[QLabel, ...]] = {}
        for column, stage in enumerate(STAGES, 1):
            name = label(stage.replace("_", " "), "dim")
            self.values[stage] = tuple(label("\N{EN DASH}") for _ in _COLUMNS)
            for row, widget in enumerate((name, *self.values[stage])):
                widget.setToolTip(f"{stage.replace('_', ' ')}: {MEANINGS[stage]}")
                widget.setAlignment(Qt.AlignmentFlag.AlignRight)
                grid.addWidget(widget, row, column)
            grid.setColumnMinimumWidth(column, self.fontMetrics().horizontalAdvance(_WIDEST))
        grid.setColumnStretch(len(STAGES) + 1, 1)
        self.hide()

    def toggle(self) -> None:
        """Show or hide the row."""
        self.setVisible(self.isHidden())

    def update_text(self, summaries: Summaries) -> None:
        """Update the numbers."""
        for stage, values in self.values.items():
            for value, number in zip(values, _numbers(summaries[stage]), strict=True):
                value.setText(number)


def timing_table(summaries: Summaries) -> str:
    """Return all stages as an HTML table."""
    rows = "".join(
        f"<tr><td>{stage.replace('_', ' ')}&nbsp;</td><td align='right'>{' / '.join(_numbers(summaries[stage]))}&nbsp;"
        f"</td><td>{MEANINGS[stage]}</td></tr>"
        for stage in STAGES
    )
    return f"<table><tr><td></td><td>{' / '.join(_COLUMNS)}, ms&nbsp;</td><td></td></tr>{rows}</table>"


def _numbers(summary: StageTimes) -> tuple[str, ...]:
    """Format the times of a stage in ms."""
    times_s = (summary.p50_s, summary.p99_s, summary.max_s)
    return tuple(f"{seconds * 1e3:.1f}" if summary.count else "\N{EN DASH}" for seconds in times_s)
