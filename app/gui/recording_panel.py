"""Recording: start and stop, keep what has just been seen, and how it goes."""

from __future__ import annotations

import math

from PyQt6.QtCore import Qt, pyqtSignal
from PyQt6.QtWidgets import QHBoxLayout, QSizePolicy, QWidget

from app.gui import theme
from app.gui.widgets import ElidedLabel, button, toggle
from app.recording.background import RecordingState
from app.recording.recorder import RECENT_S

_WIDEST = "000000 frames   00:00   000 wait for the disk   room for 000 min"
_BEHIND = 70  # frames that wait for the disk; fewer are no news


class RecordingPanel(QWidget):
    """Emits what its user wants; shows how the recording stands."""

    record_requested = pyqtSignal(bool)
    keep_requested = pyqtSignal()

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.record = toggle("Record", "Record every frame, with all that it takes to reconstruct it again (W)")
        self.record.clicked.connect(self.record_requested)
        self.keep = button(
            f"Keep last {RECENT_S:g} s", "Write the last seconds as a recording, although none was under way (K)"
        )
        self.keep.clicked.connect(self.keep_requested)
        self.text = ElidedLabel("dim")
        self.text.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        # A menu bar does not ask its corner again how wide it would be.
        self.text.setFixedWidth(self.text.fontMetrics().horizontalAdvance(_WIDEST))
        self.text.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        row = QHBoxLayout(self)
        row.setContentsMargins(10, 3, 6, 3)
        row.setSpacing(6)
        for widget in (self.text, self.keep, self.record):
            row.addWidget(widget)
        self.record.setMinimumWidth(self.record.sizeHint().width() + 20)  # the same for its other word
        self.show_state(None)

    def show_state(self, state: RecordingState | None, free_minutes: float = math.inf) -> None:
        """Show how the recording stands that is under way, or the last one, and how long a recording could become."""
        is_recording = state is not None and state.stage == "recording"
        self.record.setChecked(is_recording)
        self.record.setText("Stop" if is_recording else "Record")
        self.record.setIcon(theme.start_or_stop(is_running=True) if is_recording else theme.lamp(theme.RED))
        self.record.setEnabled(state is None or state.stage != "finishing")
        room = () if math.isinf(free_minutes) else (f"room for {_duration(free_minutes)}",)
        text = "   ".join((*_progress(state), *room))
        self.text.setText(text)
        self.text.setToolTip(text if state is None else f"{text}\n{state.folder}")


def _progress(state: RecordingState | None) -> tuple[str, ...]:
    if state is None:
        return ()
    minutes, seconds = divmod(round(state.seconds), 60)
    behind = (f"{state.waiting} wait for the disk",) if state.waiting > _BEHIND else ()
    return (f"{state.frames} frames", f"{minutes}:{seconds:02d}", *behind)


def _duration(minutes: float) -> str:
    return f"{minutes / 60:.0f} h" if minutes >= 600 else f"{minutes:.0f} min"
