"""The recording panel: start, stop, save the last seconds, and the state of the recording."""

import math

from PyQt6.QtCore import QEvent, Qt, pyqtSignal
from PyQt6.QtWidgets import QSizePolicy, QWidget

from app.gui import theme
from app.gui.widgets import ElidedLabel, button, row, toggle
from app.gui.wording import gaps_in_words
from app.progress import counted
from app.recording.recorder import RECENT_S, RecordingState

_WIDEST = "000000 frames   00:00   disk space for 000 min"  # more is cut off; the tool tip has it
_STOP = "Stop recording"
_BEHIND = 70  # waiting frames from which the number is shown


class RecordingPanel(QWidget):
    """Emits the user's requests and shows the state of the recording."""

    record_requested = pyqtSignal(bool)
    keep_requested = pyqtSignal()

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.record = toggle(
            "Record", "Record every frame with all data needed to reconstruct it again (W)", self.record_requested
        )
        self.keep = button(
            f"Save last {RECENT_S:g} s", f"Save the last {RECENT_S:g} s as a recording (K)", self.keep_requested
        )
        self.text = ElidedLabel("dim")
        self.text.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        # A menu bar never updates the width of its corner; with a fixed height, too, a new text is not laid out.
        self.text.setFixedSize(self.text.fontMetrics().horizontalAdvance(_WIDEST), self.text.minimumHeight())
        self.text.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.record_requested.connect(self._leave_fields)
        row(self.text, self.keep, self.record, parent=self).setContentsMargins(10, 3, 6, 3)
        self._show_button(is_recording=True)
        self.record.setMinimumWidth(self.record.sizeHint().width())  # of the longer of its two texts
        self._show_button(is_recording=False)
        self.show_state(None)

    def show_state(
        self, state: RecordingState | None, free_minutes: float = math.inf, *, is_starting: bool = False
    ) -> None:
        """Show the current or last recording and the recording time that the disk has space for."""
        is_recording = is_starting or (state is not None and state.stage == "recording")
        self.record.setChecked(is_recording)
        if (self.record.text() == _STOP) != is_recording:
            self._show_button(is_recording=is_recording)
        self.record.setEnabled(state is None or state.stage != "finishing")
        room = () if math.isinf(free_minutes) else (f"disk space for {_duration(free_minutes)}",)
        text = "   ".join((*_progress(state), *room))
        self.text.setText(text)
        self.text.setToolTip(text if state is None else f"{text}\n{state.folder}")

    def changeEvent(self, event: QEvent | None) -> None:  # noqa: N802 - Qt's name
        """Follow the theme."""
        super().changeEvent(event)
        if event is not None and event.type() == QEvent.Type.PaletteChange:
            self._show_button(is_recording=self.record.text() == _STOP)

    def _leave_fields(self) -> None:
        if (window := self.window()) is not None:
            window.setFocus()

    def _show_button(self, *, is_recording: bool) -> None:
        self.record.setText(_STOP if is_recording else "Record")
        self.record.setIcon(theme.start_or_stop(is_running=True) if is_recording else theme.lamp(theme.RED))


def _progress(state: RecordingState | None) -> tuple[str, ...]:
    if state is None:
        return ()
    minutes, seconds = divmod(round(state.seconds), 60)
    behind = (f"{state.waiting} waiting for the disk",) if state.waiting > _BEHIND else ()
    gap = (gaps_in_words(state.gaps),) if state.gaps else ()
    return (counted(state.frames), f"{minutes}:{seconds:02d}", *gap, *behind)


def _duration(minutes: float) -> str:
    return f"{minutes / 60:.0f} h" if minutes >= 600 else f"{minutes:.0f} min"
