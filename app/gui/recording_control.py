"""What stands between the recording's buttons and the acquisition: where recordings go, and what became of them."""

from __future__ import annotations

import math
import time
from datetime import datetime
from pathlib import Path

from PyQt6.QtCore import QStandardPaths
from PyQt6.QtWidgets import QFileDialog, QWidget

from app.acquisition.worker import Acquisition
from app.gui.answers import Answers
from app.gui.message_strip import MessageStrip
from app.gui.recording_panel import RecordingPanel
from app.recording.background import RecordingState

_ASK_DISK_S = 2.0


class RecordingControl:
    """Follows the recordings of an acquisition, and tells once how each has ended."""

    def __init__(self, panel: RecordingPanel, messages: MessageStrip, answers: Answers) -> None:
        documents = QStandardPaths.writableLocation(QStandardPaths.StandardLocation.DocumentsLocation)
        self.folder = Path(documents or ".") / "svwfs"
        self._panel, self._messages, self._answers = panel, messages, answers
        self._told: set[Path] = set()
        self._free_minutes, self._asked_s = math.inf, -math.inf

    def choose_folder(self, parent: QWidget) -> None:
        """Let the user say where the coming recordings go."""
        chosen = QFileDialog.getExistingDirectory(parent, "Where recordings go", str(self.folder))
        if chosen:
            self.folder = Path(chosen)
            self._messages.tell(f"recordings go to {self.folder}")

    def start(self, acquisition: Acquisition) -> None:
        """Record from now on, into a folder named by the time of day, and a number if there is one of this second."""
        self._messages.alarm("")
        self._answers.expect(acquisition.start_recording(self._new_folder(), may_rename=True))

    def stop(self, acquisition: Acquisition) -> None:
        """Record no more."""
        acquisition.stop_recording()

    def keep(self, acquisition: Acquisition) -> None:
        """Write the last seconds as a recording."""
        self._answers.expect(acquisition.keep_recent(self._new_folder("-kept"), may_rename=True))

    def _new_folder(self, suffix: str = "") -> Path:
        return self.folder / f"{datetime.now().astimezone():%Y%m%d-%H%M%S}{suffix}"

    def show(self, acquisition: Acquisition) -> None:
        """Show how recordings stand; what has ended early stays in the message strip until it is dismissed."""
        if time.monotonic() > self._asked_s + _ASK_DISK_S:
            self._asked_s = time.monotonic()
            try:
                self._free_minutes = acquisition.free_minutes(self.folder)
            except OSError:  # no room is told; what stands in the way is, when a recording is to begin
                self._free_minutes = math.inf
        self._panel.show_state(acquisition.recording, self._free_minutes)
        for state in (acquisition.recording, acquisition.kept):
            if state is not None and state.stage in {"finished", "ended early"} and state.folder not in self._told:
                self._told.add(state.folder)
                self._tell(state)

    def _tell(self, state: RecordingState) -> None:
        if state.stage == "ended early":
            self._messages.alarm(f"the recording has ended early, {state.frames} frames are kept: {state.problem}")
        else:
            self._messages.tell(f"recorded {state.frames} frames in {state.folder}")
