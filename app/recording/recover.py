"""Recovery of a recording: lists its damage, rebuilds metadata, and finishes it."""

import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.bench.bench_files import read_bench_text
from app.errors import InputError, RunError
from app.files import atomic_write, remove_partial, write_whole
from app.progress import counted
from app.recording.calibration_files import read_array, read_calibration
from app.recording.folder import (
    BEFORE,
    CALIBRATION,
    FORMAT,
    FRAME_LINES,
    PIXELS,
    RESULTS,
    RUN,
    START,
    STORE,
    damaged_name,
    lock,
)
from app.recording.frame_array import METADATA, FrameArray, is_array
from app.recording.frame_lines import FoundLines, find_lines
from app.recording.reader import Recording
from app.recording.writer import make_store
from app.run_facts import now, write_record

_WHY = "recovered: the program ended before it could finish the recording"
_LISTED_RANGES = 20
_BEYOND = 100  # numbers of frames this many times what is there are damage, and would take hours to check


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
    rebuilt: tuple[str, ...] = ()  # a sentence for each file of metadata
    put_aside: str = ""  # what was removed from `frames.jsonl`, and where it is

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
    """Finish a recording: set the length of its arrays and mark it complete.

    Damaged frames in the middle stay, so that all others keep their index; lines of damaged frames at the end of an
    unfinished recording are moved to `frames.damaged.jsonl`. `InputError` if it is still being recorded.
    """
    path = folder / FRAME_LINES
    try:
        _refuse_links(folder)
        rebuilt = [_rebuild_run(folder)]
        recording = Recording(folder)
        if not path.exists():
            path.touch()
        mode = "rb" if recording.is_complete else "rb+"  # a complete recording may be read-only
        with path.open(mode) as file:
            lock(file)
            rebuilt += _rebuild_arrays(folder)
            recording.refresh()
            lines = find_lines(path)
            found = Recovered(recording.is_complete, _length(recording, lines))
            _examine(recording, lines, found, progress)
            found.rebuilt = tuple(filter(None, rebuilt))
            found.put_aside = _put_in_place(lines, found.frames, is_complete=found.was_complete)
            if found.rebuilt or not found.was_complete:
                for array in filter(is_array, _array_folders(folder / STORE)):
                    FrameArray(array).set_length(found.frames)
            if not found.was_complete:
                counts = {"recorded": found.frames, "reconstructed": found.reconstructed, "lost": found.lost}
                ended = {"complete": True, "ended": now(), "ended_early": _WHY, "frames": counts}
                write_record(folder / RUN, {**recording.run, **ended})
            if left := ", ".join(str(each.relative_to(folder)) for each in remove_partial(folder)):
                found.rebuilt += (f"half written, and removed: {left}",)
    except OSError as error:
        raise RunError(f"{error.filename or folder}: {error.strerror or error}") from error
    return found


def _refuse_links(folder: Path) -> None:
    """Raise `InputError` if recovery would change a symbolic link, whose file is not ours."""
    arrays = (f"{STORE}/{PIXELS}", f"{STORE}/{RESULTS.format('*')}/*")
    changed = ("*", f"{STORE}/*", f"{STORE}/{RESULTS.format('*')}", *arrays, *(f"{each}/{METADATA}" for each in arrays))
    for path in chain.from_iterable(map(folder.glob, changed)):
        if path.is_symlink():
            raise InputError(f"{path}: is a symbolic link; put the file or folder itself in its place")


def _length(recording: Recording, lines: FoundLines) -> int:
    """Number of frames up to the last whole one: after a power failure some may lack pixels."""
    most = _BEYOND * (1 + max(len(recording), recording.stored_frames))
    if recording.is_complete:
        recorded = recording.recorded_frames
        return len(recording) if recorded is None or recorded > most else recorded
    return max((index + 1 for index in lines.spans if index < most and recording.is_whole(index)), default=0)


def _examine(recording: Recording, lines: FoundLines, found: Recovered, progress: Callable[[float], None]) -> None:
    """Check line, pixels and results of each frame, and the calibrations and biases that the lines name."""
    without_line, without_pixels, changed, without_results = [], [], [], []
    calibrations: set[int | None] = set()
    biases: set[int | None] = set()
    starts: set[int | None] = set()
    for index in range(found.frames):
        line, has_pixels = lines.line(index), recording.is_whole(index)
        if line is None:
            without_line.append(index)
        else:
            found.reconstructed += not line.problem
            found.lost, found.gaps = found.lost + line.lost, found.gaps + (line.lost > 0)
            calibrations.add(line.calibration)
            biases.add(line.bias)
            starts.add(line.start if line.start == BEFORE else None)
            if has_pixels and not recording.has_results(line):
                without_results.append(index)
        if not has_pixels:
            without_pixels.append(index)
        elif line is not None and not recording.is_intact(line):
            changed.append(index)
        elif line is not None:
            found.whole.append(index)
        progress((index + 1) / found.frames)
    of_frames = (
        (without_line, "there is no line that can be read"),
        (without_pixels, "the pixels are missing, or some of them"),
        (changed, "the pixels are not those that were recorded"),
        (without_results, "what was found live is missing; svwfs replay finds it again"),
    )
    damaged = [f"{frames_in_words(which)}: {what}" for which, what in of_frames if which]
    unreadable = list(_faults(recording.calibration, calibrations))
    found.has_calibration = not unreadable or len(unreadable) < len(calibrations - {None})
    start = _faults(lambda _: read_array(recording.folder / START), starts)
    found.damage = (*damaged, *unreadable, *_faults(recording.bias, biases), *start)


def _faults(read: Callable[[int], object], numbers: Iterable[int | None]) -> Iterator[str]:
    for number in sorted(number for number in numbers if number is not None):
        try:
            read(number)
        except InputError as error:
            yield str(error)


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


def _put_in_place(lines: FoundLines, frames: int, *, is_complete: bool) -> str:
    """Put each line in its place and remove the rest; return where the original is, if kept."""
    path, end = lines.path, lines.end_in_place(frames)
    if end is None:
        aside = damaged_name(path)
        with atomic_write(aside) as temporary:
            shutil.copyfile(path, temporary)
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            file.writelines(lines.in_place(frames))
        return f"the original {FRAME_LINES} is in {aside.name}; in the new one every line is in its place"
    if is_complete:
        return ""
    put_aside = ""
    with path.open("rb") as file:
        file.seek(end)
        rest = file.read()
    if left_out := rest.count(b"\n"):
        aside = damaged_name(path)
        write_whole(aside, rest)
        put_aside = f"the lines after the last whole frame, {left_out} of them, are in {aside.name}"
    os.truncate(path, end)
    return put_aside


def _rebuild_run(folder: Path) -> str:
    """Make `run.json` again, as far as it is known, if it is missing or no JSON; return what was done."""
    run, bench, lines = folder / RUN, folder / CALIBRATION.format(0) / "bench.toml", folder / FRAME_LINES
    if not _is_lost(run) or not lines.is_file() or not lines.stat().st_size or not bench.is_file():
        return ""
    kept = ""
    if run.exists() and run.stat().st_size:
        kept = f"; the damaged one is {run.rename(damaged_name(run)).name}"
    write_record(run, {"format": FORMAT, "complete": False, "bench": read_bench_text(bench)})
    return f"{RUN} was missing or damaged and is made again, with the bench of the first calibration{kept}"


def _is_lost(path: Path) -> bool:
    if not path.is_file():
        return not path.exists()
    try:
        json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError):
        return True
    return False


def _rebuild_arrays(folder: Path) -> Iterator[str]:
    """Make missing or damaged metadata of the arrays again; yield what was done."""
    store = folder / STORE
    if not store.is_dir():
        return
    if not (store / METADATA).is_file():
        make_store(store)
        yield f"{STORE}/{METADATA} was missing and is made again"
    for path in filter(Path.is_dir, _array_folders(store)):
        name, metadata = path.relative_to(store).as_posix(), path / METADATA
        with suppress(InputError):
            FrameArray(path)
            continue  # it can be read
        try:
            values = _zeros_of_a_frame(folder, name)
            if metadata.exists():
                metadata.rename(metadata.with_name(f"damaged.{METADATA}"))
            FrameArray.create(store, name, values)
            yield f"{STORE}/{name}/{METADATA} was missing or damaged and is made again"
        except InputError as error:
            sentence = f"{STORE}/{name}/{METADATA} is missing or damaged and cannot be made again: {error}"
            if metadata.exists():  # no frame could be examined
                raise InputError(sentence) from error
            yield sentence


def _array_folders(store: Path) -> list[Path]:
    """Folders of frames and results, displacements of a calibration before its coefficients."""
    return [store / PIXELS, *sorted(store.glob(RESULTS.format("*") + "/*"), reverse=True)]


def _zeros_of_a_frame(folder: Path, name: str) -> NDArray[np.uint16] | NDArray[np.float64]:
    """Return zeros like one frame of an array; `InputError` if no calibration tells its shape."""
    size = _chunk_bytes(folder / STORE / name)
    group, _, kind = name.rpartition("/")
    calibration = read_calibration(folder / CALIBRATION.format(group.rpartition("/")[2] or 0))
    sensor = calibration.bench.sensor
    lenslets = sensor.lenslet_rows, sensor.lenslet_columns
    if name == PIXELS:
        pixels = np.zeros(calibration.reference.mean.shape, np.uint16)
        if size == pixels.nbytes:
            return pixels
    elif kind == "displacement" and size % (16 * lenslets[0] * lenslets[1]) == 0:
        return np.zeros((*lenslets, size // (16 * lenslets[0] * lenslets[1]), 2))
    elif kind == "coefficients":
        field_modes = FrameArray(folder / STORE / group / "displacement").shape[2]
        if size % (8 * field_modes) == 0:
            return np.zeros((size // (8 * field_modes), field_modes))
    raise InputError(f"the chunks of {name} do not fit the calibration")


def _chunk_bytes(array: Path) -> int:
    """Size of the largest chunk; a last one may be cut short."""
    chunks = array.glob("c/*/0/0" if array.name == PIXELS else "c.*")
    return max((chunk.stat().st_size for chunk in chunks), default=0)
