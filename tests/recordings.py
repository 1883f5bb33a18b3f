"""Recordings of the small simulated bench, for tests of what is done with them afterwards."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from app.acquisition import Acquisition
from app.config import load_bench
from app.devices import open_devices
from app.recording.reader import Recording
from app.start_up import start_up


def record(
    toml: Path,
    folder: Path,
    *settings: str,
    frames: int = 12,
    before: Callable[[Acquisition], None] = lambda _: None,
    meanwhile: Callable[[Acquisition], None] = lambda _: None,
) -> Recording:
    """Record `frames` frames, `meanwhile` after the first half of them; return the finished recording."""
    acquisition = Acquisition(load_bench(toml, settings), open_devices)
    acquisition.start()
    try:
        for step in start_up(acquisition, 4):
            step.result(30)
        before(acquisition)
        acquisition.start_recording(folder, frames=frames).result(10)
        wait_for(acquisition, frames // 2)
        meanwhile(acquisition)
        wait_for(acquisition, frames)
    finally:
        acquisition.close()
    return Recording(folder)


def wait_for(acquisition: Acquisition, frames: int) -> None:
    """Wait until so many frames have been recorded."""
    deadline_s = time.monotonic() + 60
    while acquisition.recording is None or acquisition.recording.frames < frames:
        assert time.monotonic() < deadline_s
        assert acquisition.is_alive, acquisition.failure
        assert acquisition.recording is None or not acquisition.recording.problem
        time.sleep(0.005)


def until_refined(acquisition: Acquisition) -> None:
    """Wait until frames are corrected by what the refinement has found."""
    deadline_s = time.monotonic() + 60
    while acquisition.newest is None or acquisition.newest.refinement.stage != "applied":
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


def edit_line(recording: Recording, index: int, **changes: Any) -> None:
    """Change what a recording says of a frame."""
    path = recording.folder / "frames.jsonl"
    lines = path.read_text().splitlines()
    lines[index] = json.dumps({**json.loads(lines[index]), **changes})
    path.write_text("".join(line + "\n" for line in lines))
