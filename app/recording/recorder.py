"""Takes every measurement: keeps the last seconds in memory, and has them written while a recording is on."""

from __future__ import annotations

import math
import shutil
import threading
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from app.errors import InputError
from app.files import nearest_existing
from app.measurement.measurement import Measurement
from app.recording.background import BackgroundRecording, RecordingState
from app.recording.folder import check_free, new_folder
from app.recording.record import Record
from app.timing import Timings

RECENT_S = 10.0
_RECENT_BYTES = 1e9


class Recorder:
    """The recorder of one acquisition, whose worker gives it the measurements."""

    def __init__(self, timings: Timings) -> None:
        self._timings = timings
        self._recent: deque[Record] = deque()
        self._recent_bytes = 0
        self._lost = 0
        self._recording: BackgroundRecording | None = None
        self._kept: BackgroundRecording | None = None
        self._changing = threading.Lock()

    def take(self, measurement: Measurement) -> None:
        """Take one more; nothing here waits for the disk."""
        record = Record.of(measurement, measurement.counts.lost - self._lost)
        self._lost = measurement.counts.lost
        with self._changing:
            self._recent.append(record)
            self._recent_bytes += record.nbytes
            oldest_s = record.frame.host_time_s - RECENT_S
            while self._recent[0].frame.host_time_s < oldest_s or self._recent_bytes > _RECENT_BYTES:
                self._recent_bytes -= self._recent.popleft().nbytes
            if self._recording is not None:
                self._recording.take(record)

    def start(
        self, folder: Path, facts: Mapping[str, Any], *, frames: int | None = None, may_rename: bool = False
    ) -> None:
        """Record into a folder from the next measurement on, `frames` of them or until it is stopped.

        `InputError` when the folder holds a recording, or one is under way. With `may_rename` a number is put after a
        name that is taken; `state` tells the folder.
        """
        if not may_rename:
            check_free(folder)
        with self._changing:
            if self._recording is not None and self._recording.state.stage in {"recording", "finishing"}:
                raise InputError(f"{self._recording.state.folder}: is still being recorded")
            folder = new_folder(folder) if may_rename else folder
            self._recording = BackgroundRecording(folder, facts, self._timings, frames=frames)

    def stop(self, problem: str = "") -> None:
        """End the recording that is under way, if any; it is finished soon after."""
        if self._recording is not None:
            self._recording.stop(problem)

    def keep_recent(self, folder: Path, facts: Mapping[str, Any], *, may_rename: bool = False) -> None:
        """Write the last seconds as a recording, whether or not one is under way; see `start`."""
        if not may_rename:
            check_free(folder)
        with self._changing:
            if self._kept is not None and self._kept.state.stage == "finishing":
                raise InputError(f"{self._kept.state.folder}: is still being written")
            if not self._recent:
                raise InputError("there is no frame yet that could be kept")
            folder = new_folder(folder) if may_rename else folder
            self._kept = BackgroundRecording(folder, facts, Timings(), records=tuple(self._recent))
            self._kept.stop()

    def forget_recent(self) -> None:
        """Keep nothing of what came until now: frames that come from now on are of another kind."""
        with self._changing:
            self._recent.clear()
            self._recent_bytes = 0

    def close(self, problem: str) -> None:
        """End and finish whatever is being written; `problem` is why, if it is early."""
        self.stop(problem)
        for recording in (self._recording, self._kept):
            if recording is not None:
                recording.join()

    @property
    def state(self) -> RecordingState | None:
        """How the recording stands that is under way, or the last one; None before the first."""
        return None if self._recording is None else self._recording.state

    @property
    def kept_state(self) -> RecordingState | None:
        """Likewise of the last seconds that were kept last."""
        return None if self._kept is None else self._kept.state

    @property
    def recent_frames(self) -> int:
        """How many frames could be kept."""
        return len(self._recent)

    def free_minutes(self, folder: Path) -> float:
        """How long could be recorded into a folder, there or not yet, at the rate of the last seconds.

        Infinite when no frames come; `OSError` when the disk cannot be asked. It may take long on a network.
        """
        with self._changing:
            spanned_s = self._recent[-1].frame.host_time_s - self._recent[0].frame.host_time_s if self._recent else 0.0
            nbytes = self._recent_bytes
        if spanned_s <= 0:
            return math.inf
        return shutil.disk_usage(nearest_existing(folder)).free / (nbytes / spanned_s) / 60
