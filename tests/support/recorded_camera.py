"""A recording that a camera plays, and copies of it."""

from __future__ import annotations

import shutil
from pathlib import Path

from app.recording.reader import Recording
from support.recordings import edit_line, record

FRAMES = 6
EXPOSURE_S = 0.02


def steady_recording(toml: Path, folder: Path) -> Recording:
    """Frames that came one exposure after another."""
    recording = record(toml, folder, frames=FRAMES)
    for index in range(FRAMES):
        edit_line(recording, index, host_time_s=1000 + index * EXPOSURE_S, lost=0, light_current_a=0.25)
    return Recording(folder)


def copied(recording: Recording, folder: Path) -> Recording:
    shutil.copytree(recording.folder, folder)
    return Recording(folder)
