"""Recovery of a recording after a crash, a power failure, a full disk or an incomplete copy."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from app.errors import InputError, RunError
from app.files import remove_partial, write_whole
from app.progress import counted
from app.recording.folder import FRAME_LINES, PIXELS, RESULTS, RUN, STORE, damaged_name, lock
from app.recording.frame_array import DamagedFrame, FrameArray, is_array
from app.recording.frame_lines import UNREADABLE, FrameLine
from app.recording.reader import Recording
from app.run_facts import now, write_record

_WHY = "recovered: the program ended before it could finish the recording"
_LISTED_RANGES = 20


@dataclass(slots=True)
class Recovered:
    """State of a recording after recovery."""

    was_complete: bool  # then only misplaced lines were put in their places
    frames: int
    reconstructed: int = 0
    lost: int = 0  # by the camera, in gaps
    gaps: int = 0
    damage: tuple[str, ...] = ()  # a sentence for each kind
    whole: list[int] = field(default_factory=list)  # frames whose line and pixels are readable
    has_calibration: bool = True  # False if frames name calibrations, and none can be read
    put_aside: str = ""  # what was removed from `frames.jsonl`, and where it is
    removed: tuple[Path, ...] = ()  # half-written files

    @property
    def summary(self) -> str:
        """The numbers in words."""
        if not self.frames:
            return "it holds no frame"
        text = f"{counted(self.frames)}, {self.reconstructed} of them reconstructed live"
        return text + (f"; the camera lost {self.lost} in {counted(self.gaps, 'gap')}" if self.lost else "; no gaps")

    @property
    def readable(self) -> str:
        """Frames that are whole and how to select them; empty if all are."""
        if len(self.whole) == self.frames:
            return ""
        if not self.whole:
            return "no frame is whole"
        longest = max(_ranges_of(self.whole), key=len)
        chosen = f"{longest.start}:{longest.stop}"
        some = f"replay, batch, export and report take some with --frames, as {chosen}"
        return f"whole: {frames_in_words(self.whole)}; {some}"


def recover(folder: Path, progress: Callable[[float], None] = lambda _: None) -> Recovered:
    """Finish a recording: set the length of its arrays and mark it complete; list its damage.

    Damaged frames in the middle stay, so that all others keep their index. Lines that leave `frames.jsonl` are kept in
    `frames.damaged.jsonl`. `InputError` if it is still being recorded.
    """
    try:
        recording = Recording(folder)
        folder = recording.folder
        if not (folder / FRAME_LINES).exists():
            (folder / FRAME_LINES).touch()
        with _locked(recording) as file:
            lines = file.read().splitlines(keepends=True)
        found = Recovered(recording.is_complete, 0)
        found.frames, found.put_aside = _put_in_place(recording, lines)  # Windows replaces no file that is open
        with _locked(recording):
            recording = Recording(folder)
            _examine(recording, found, progress)
            if not found.was_complete:
                _finish(recording, found)
            found.removed = tuple(each.relative_to(folder) for each in remove_partial(folder))
    except OSError as error:
        raise RunError(f"{error.filename or folder}: {error.strerror or error}") from error
    return found


@contextmanager
def _locked(recording: Recording) -> Iterator[IO[bytes]]:
    mode = "rb" if recording.is_complete else "rb+"  # a complete recording may be read-only
    with (recording.folder / FRAME_LINES).open(mode) as file:
        lock(file)
        yield file


def _put_in_place(recording: Recording, lines: list[bytes]) -> tuple[int, str]:
    """Put lines at the places of their indices; return the number of whole frames, and where the old lines are."""
    by_index = dict[int, bytes]()
    for text in lines:
        if (index := _index_of(text)) is not None:
            by_index.setdefault(index, text)
    if recording.is_complete:
        recorded = recording.recorded_frames
        frames = len(recording) if recorded is None else recorded
    else:
        frames = max((index + 1 for index in by_index if recording.is_whole(index)), default=0)
    placed = [by_index.get(index, UNREADABLE) for index in range(frames)]
    if placed == lines:
        return frames, ""
    path, aside = recording.folder / FRAME_LINES, ""
    left_out = [text for text in lines[len(placed) :] if text.endswith(b"\n")]
    if placed != lines[: len(placed)] or left_out:  # not only the half of a last line
        kept = damaged_name(path)
        write_whole(kept, b"".join(lines))
        aside = f"the original {FRAME_LINES} is in {kept.name}; in the new one every line is in its place"
    write_whole(path, b"".join(placed))
    return frames, aside


def _index_of(text: bytes) -> int | None:
    try:
        return FrameLine.from_json(text).index if text.endswith(b"\n") else None
    except ValueError:
        return None


def _examine(recording: Recording, found: Recovered, progress: Callable[[float], None]) -> None:
    """Check line and pixels of each frame, and the calibrations and biases that the lines name."""
    without_line, without_pixels = list[int](), list[int]()
    calibrations, biases = set[int | None](), set[int | None]()
    for index in range(found.frames):
        try:
            line = recording.line(index)
        except DamagedFrame:
            without_line.append(index)
        else:
            found.reconstructed += not line.problem
            found.lost, found.gaps = found.lost + line.lost, found.gaps + (line.lost > 0)
            calibrations.add(line.calibration)
            biases.add(line.bias)
        try:
            recording.pixels(index)
        except InputError:
            without_pixels.append(index)
        progress((index + 1) / found.frames)
    damaged = {*without_line, *without_pixels}
    found.whole = [index for index in range(found.frames) if index not in damaged]
    of_frames = (
        (without_line, "there is no line that can be read"),
        (without_pixels, "the pixels are missing, cut short, or not those that were recorded"),
    )
    sentences = [f"{frames_in_words(which)}: {what}" for which, what in of_frames if which]
    unreadable = list(_faults(recording.calibration, calibrations))
    found.has_calibration = not unreadable or len(unreadable) < len(calibrations - {None})
    found.damage = (*sentences, *unreadable, *_faults(recording.bias, biases))


def _faults(read: Callable[[int], object], numbers: Iterable[int | None]) -> Iterator[str]:
    for number in sorted(number for number in numbers if number is not None):
        try:
            read(number)
        except InputError as error:
            yield str(error)


def _finish(recording: Recording, found: Recovered) -> None:
    """Set the length of the arrays and mark the recording complete."""
    store = recording.folder / STORE
    for path in filter(is_array, [store / PIXELS, *store.glob(RESULTS.format("*") + "/*")]):
        FrameArray(path).finish(found.frames)
    counts = {"recorded": found.frames, "reconstructed": found.reconstructed, "lost": found.lost}
    ended = {"complete": True, "ended": now(), "ended_early": _WHY, "frames": counts}
    write_record(recording.folder / RUN, {**recording.run, **ended})


def frames_in_words(frames: Sequence[int]) -> str:
    """Name sorted frames: "frames 0 to 2 and 4"."""
    ranges = _ranges_of(frames)
    named = [f"{some[0]}" if len(some) == 1 else f"{some[0]} to {some[-1]}" for some in ranges[:_LISTED_RANGES]]
    if len(ranges) > _LISTED_RANGES:
        named.append(f"{sum(map(len, ranges[_LISTED_RANGES:]))} more")
    text = " and ".join([", ".join(named[:-1]), named[-1]] if len(named) > 1 else named)
    return f"frame{'s' * (len(frames) != 1)} {text or 'none'}"


def _ranges_of(frames: Sequence[int]) -> list[range]:
    """Join consecutive frames into ranges."""
    parts = np.split(np.array(frames, np.int64), np.flatnonzero(np.diff(frames) != 1) + 1)
    return [range(int(part[0]), int(part[-1]) + 1) for part in parts if part.size]
