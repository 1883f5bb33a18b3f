"""Finishes a recording whose program died before it could, and says what of a recording is damaged."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

from app.errors import RunError
from app.files import atomic_write
from app.recording.damage import Examined, examine, frames_in_words, ranges_of
from app.recording.frame_array import FrameArray, is_array
from app.recording.layout import FRAMES, PIXELS, RUN, STORE, results_of
from app.recording.line_places import LinePlaces, find_lines
from app.recording.lock import lock
from app.recording.reader import Recording
from app.run_facts import now, write_record

_WHY = "recovered: the program ended before it could finish the recording"


@dataclass(frozen=True, slots=True)
class Recovered:
    """What was found in a recording."""

    was_complete: bool  # then nothing has been done, but for lines that did not stand where they belong
    frames: int
    reconstructed: int
    lost: int  # by the camera, in gaps
    gaps: int
    damage: tuple[str, ...]  # a sentence for each kind; empty when all is whole
    whole: Sequence[int]  # frames whose line and pixels can be read
    put_aside: str  # what no longer is in `frames.jsonl`, and where it is; empty when all still is

    @property
    def summary(self) -> str:
        """The numbers in words."""
        text = f"{self.frames} frames, {self.reconstructed} of them reconstructed live"
        return text + (f"; the camera lost {self.lost} in {self.gaps} gaps" if self.lost else "; no gaps")

    @property
    def readable(self) -> str:
        """Which frames are whole, in words, and how a command is told to take them; empty when all are."""
        if len(self.whole) == self.frames:
            return ""
        if not self.whole:
            return "no frame is whole"
        longest = max(ranges_of(self.whole), key=len)
        chosen = f"{longest.start}:{longest.stop}"
        return f"whole: {frames_in_words(self.whole)}; replay, export and report take some with --frames, as {chosen}"


def recover(folder: Path, progress: Callable[[float], None] = lambda _: None) -> Recovered:
    """Finish a recording: arrays as long as there are frames, `run.json` complete. Nothing that was read is lost.

    Damaged frames in the middle stay among the others, which all can be read; at the end of one that was not complete
    their lines are put aside. `InputError` when the folder holds no recording, or it is still being recorded.
    """
    recording = Recording(folder)
    path = folder / FRAMES
    try:
        if not path.exists():
            path.touch()
        mode = "rb" if recording.is_complete else "rb+"  # what is complete may lie where nothing can be written
        with path.open(mode) as file:
            lock(file)
            recording.refresh()
            was_complete = recording.is_complete
            lines = find_lines(path)
            frames = _length(recording, lines)
            examined = examine(recording, lines, frames, progress)
            put_aside = _put_in_place(lines, frames, is_complete=was_complete)
            if not was_complete:
                _finish(recording, frames, examined)
    except OSError as error:
        raise RunError(f"{error.filename or folder}: {error.strerror or error}") from error
    return Recovered(
        was_complete,
        frames,
        examined.reconstructed,
        examined.lost,
        examined.gaps,
        examined.damage,
        examined.whole,
        put_aside,
    )


def _length(recording: Recording, lines: LinePlaces) -> int:
    """How many frames there are: up to the last that is whole; after a power cut a line may have outlived its frame."""
    if recording.is_complete:
        counts = recording.run.get("frames")
        recorded = counts.get("recorded") if isinstance(counts, dict) else None
        return recorded if type(recorded) is int and recorded >= 0 else len(recording)  # true is no number
    return max((index + 1 for index in lines.spans if recording.is_whole(index)), default=0)


def _put_in_place(lines: LinePlaces, frames: int, *, is_complete: bool) -> str:
    """Have each line where it belongs, and nothing after them; whatever was there but a half line is put aside."""
    path, end = lines.path, lines.end_in_place(frames)
    if end is None:
        aside = _aside(path)
        with atomic_write(aside) as temporary:
            shutil.copyfile(path, temporary)
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            file.writelines(lines.in_place(frames))
        return f"{FRAMES} as it was is in {aside.name}; in the new one every line stands where it belongs"
    if is_complete:
        return ""
    said = ""
    with path.open("rb") as file:
        file.seek(end)
        rest = file.read()
    if left_out := rest.count(b"\n"):
        aside = _aside(path)
        with atomic_write(aside) as temporary:
            temporary.write_bytes(rest)
        said = f"the lines after the last whole frame, {left_out} of them, are in {aside.name}"
    os.truncate(path, end)
    return said


def _aside(path: Path) -> Path:
    """A name that is free, for what is put aside."""
    names = chain(["damaged"], (f"damaged-{number}" for number in count(2)))
    return next(each for name in names if not (each := path.with_suffix(f".{name}{path.suffix}")).exists())


def _finish(recording: Recording, frames: int, examined: Examined) -> None:
    """Make the arrays as long as there are frames, and say in `run.json` that it is complete."""
    store = recording.folder / STORE
    for path in (store / PIXELS, *sorted(store.glob(results_of("*") + "/*"))):
        if is_array(path):
            FrameArray(path).set_length(frames)
    counts = {"recorded": frames, "reconstructed": examined.reconstructed, "lost": examined.lost}
    ended = {"complete": True, "ended": now(), "ended_early": _WHY, "frames": counts}
    write_record(recording.folder / RUN, {**recording.run, **ended})
