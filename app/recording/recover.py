"""Finishes a recording whose program died before it could."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from app.errors import InputError, RunError
from app.files import appearing_whole
from app.recording.frame_array import FrameArray, is_array
from app.recording.layout import FRAMES, PIXELS, RUN, STORE, results_of
from app.recording.lock import lock
from app.recording.reader import Recording
from app.run_facts import now, write_record

_WHY = "recovered: the program ended before it could finish the recording"
_REST = "frames.damaged.jsonl"


@dataclass(frozen=True, slots=True)
class Recovered:
    """What was found in a recording."""

    was_complete: bool  # then nothing has been done
    frames: int
    reconstructed: int
    lost: int  # by the camera, in gaps
    gaps: int
    left_out: str  # what could not be kept, and where it lies; empty when all could

    @property
    def summary(self) -> str:
        """The numbers in words."""
        text = f"{self.frames} frames, {self.reconstructed} of them reconstructed live"
        return text + (f"; the camera lost {self.lost} in {self.gaps} gaps" if self.lost else "; no gaps")


def recover(folder: Path, progress: Callable[[float], None] = lambda _: None) -> Recovered:
    """Finish a recording: arrays as long as there are frames, `run.json` complete. Nothing that was read is lost.

    `InputError` when the folder holds no recording, or it is still being recorded.
    """
    recording = Recording(folder)
    if not (folder / FRAMES).exists():
        _write((folder / FRAMES).touch)
    with (folder / FRAMES).open("rb+") as lines:
        lock(lines)
        recording.refresh()
        found = _count(recording, progress)
        if found.was_complete:
            return found
        counts = {"recorded": found.frames, "reconstructed": found.reconstructed, "lost": found.lost}
        _write(lambda: _cut(recording, found.frames))
        for path in (folder / STORE / PIXELS, *sorted((folder / STORE).glob(results_of("*") + "/*"))):
            if is_array(path):
                FrameArray(path).set_length(found.frames)
        why = recording.ended_early or _WHY
        ended = {"complete": True, "ended": now(), "ended_early": why, "frames": counts}
        write_record(folder / RUN, {**recording.run, **ended})
    if found.left_out:
        return replace(found, left_out=f"{found.left_out}: their lines are in {_REST}")
    return found


def _count(recording: Recording, progress: Callable[[float], None]) -> Recovered:
    """Look at every frame, up to the first that is not whole: after a power cut a line may have outlived its frame."""
    total = len(recording)
    frames = reconstructed = lost = gaps = 0
    left_out = ""
    for index in range(total):
        try:
            line = recording.line(index)
            fault = "" if recording.is_whole(index) else f"the pixels of frame {index} are not whole"
        except InputError as error:
            fault = str(error)
        if fault:
            left_out = f"{fault}; left out with the {total - index - 1} frames after it"
            break
        frames, reconstructed = frames + 1, reconstructed + (not line.problem)
        lost, gaps = lost + line.lost, gaps + (line.lost > 0)
        progress((index + 1) / total)
    return Recovered(recording.is_complete, frames, reconstructed, lost, gaps, left_out)


def _cut(recording: Recording, frames: int) -> None:
    """Leave the lines of so many frames; whatever follows but a half line goes into a file of its own."""
    path = recording.folder / FRAMES
    kept = recording.end_of(frames)
    if recording.end_of(len(recording)) > kept:
        with path.open("rb") as lines, appearing_whole(recording.folder / _REST) as temporary:
            lines.seek(kept)
            temporary.write_bytes(lines.read())
    os.truncate(path, kept)


def _write(change: Callable[[], None]) -> None:
    try:
        change()
    except OSError as error:
        raise RunError(f"{error.filename}: cannot be written: {error.strerror or error}") from error
