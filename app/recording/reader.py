"""Reader of recordings: finished, cut short, or still growing."""

import re
from array import array
from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.bench_files import written_by
from app.bench.config import Bench, parse_bench
from app.errors import InputError
from app.files import check_readable, reachable
from app.measurement.calibration import Calibration
from app.recording.calibration_files import read_array, read_calibration
from app.recording.folder import (
    BIAS,
    CALIBRATION,
    FRAME_LINES,
    PIXELS,
    RESULTS,
    RUN,
    STORE,
    read_run,
    recorded_frames,
    version_of,
)
from app.recording.frame_array import HINT, DamagedFrame, FrameArray, is_array
from app.recording.frame_lines import FrameLine, checksum
from drivers.interface import Frame
from reconstruction.arrays import Floats

_PIECE_BYTES = 1 << 20
_MOST_SKIPPED = 100  # frames in a row, which a busy computer did not reconstruct
_UNCHANGED = ("began", "began_host_s", "bench")  # keys of `run.json` that tell recordings apart


class Recording:
    """A recording on disk, opened for reading; nothing on disk is changed.

    It holds no pixels: each call reads one frame, so that memory does not grow with the number of frames. Frames are
    counted from 0; `len` is the number of complete lines in `frames.jsonl`. If the folder is renamed meanwhile, the
    recording is found again under its new name. Every method raises an `InputError` if what it reads is missing or
    damaged, and so does opening a folder that holds no recording.
    """

    def __init__(self, folder: Path | str) -> None:
        self._folder = reachable(Path(folder))
        self._arrays: dict[str, FrameArray | None] = {}
        self.run = read_run(self._folder)  # contents of `run.json`
        self._ends = array("q", [0])  # end of each line, bytes; the first number is the start of the first line
        self._calibrations = lru_cache(4)(lambda number: read_calibration(self.folder / CALIBRATION.format(number)))
        self._biases = lru_cache(4)(lambda number: read_array(self.folder / BIAS.format(number)))
        self.refresh()

    def __len__(self) -> int:
        return len(self._ends) - 1

    def refresh(self) -> int:
        """Look for new frames and for the end of the recording; return the number of frames."""
        path = self.folder / FRAME_LINES
        try:
            if path.exists():
                check_readable(path)
            with path.open("rb") as file:
                file.seek(self._ends[-1])
                while piece := file.read(_PIECE_BYTES):
                    after = file.tell() - len(piece) + 1
                    self._ends.extend((np.flatnonzero(np.frombuffer(piece, np.uint8) == ord("\n")) + after).tolist())
        except FileNotFoundError:  # the recording has just begun
            pass
        except OSError as error:
            raise _unreadable(path, error) from error
        if not self.is_complete:
            self.run = read_run(self.folder)
        return len(self)

    @property
    def folder(self) -> Path:
        """The folder; it is found again if a person has renamed it."""
        with suppress(OSError):  # the disk is gone: the next read shows
            if not self._folder.exists():
                beside = (one for one in self._folder.parent.iterdir() if (one / RUN).is_file())
                self._folder = next(filter(self._is_in, beside), self._folder)
                self._arrays.clear()
        return self._folder

    def _is_in(self, folder: Path) -> bool:
        try:
            run = read_run(folder)
        except InputError:
            return False
        return all(run.get(key) == self.run.get(key) for key in _UNCHANGED)

    @property
    def is_complete(self) -> bool:
        """True if the recording was finished; if not, it still grows, or its program died (`svwfs recover`)."""
        return bool(self.run["complete"])

    @property
    def recorded_frames(self) -> int | None:
        """Number of frames according to `run.json`; None if it does not tell."""
        return recorded_frames(self.run)

    @property
    def lost_lines(self) -> str:
        """A sentence on the frames of a complete recording that have no line; empty if all have one."""
        lost = (self.recorded_frames or 0) - len(self)
        if not self.is_complete or lost <= 0:
            return ""
        return f"{self.folder}: {lost} of {self.recorded_frames} frames have no line; svwfs recover lists them"

    @property
    def ended_early(self) -> str:
        """Reason why the recording ended early; empty if it did not."""
        return str(self.run.get("ended_early", ""))

    @property
    def bench(self) -> Bench:
        """The bench at the beginning; each calibration has its own, with the lattice in force."""
        with written_by(self.folder, version_of(self.run)):
            return parse_bench(str(self.run["bench"]), f"{self.folder / RUN}: bench")

    def first_calibration(self, frames: Iterable[int]) -> int | None:
        """Return the number of the first calibration of these frames; None if they have none."""
        numbers = (self.line(index).calibration for index in frames)
        return next((number for number in numbers if number is not None), None)

    def select(self, text: str | None) -> range:
        """Parse FIRST:END, counted from 0 or, if negative, from the end; END is excluded; None selects all."""
        return selected(text, len(self), self.folder)

    def line(self, index: int) -> FrameLine:
        """Times, exposure, light, calibration and outcome of a frame."""
        if not 0 <= index < len(self):
            raise InputError(f"{self.folder}: has no frame {index}; it has {len(self)}")
        path = self.folder / FRAME_LINES
        try:
            with path.open("rb") as file:
                file.seek(self._ends[index])
                text = file.read(self._ends[index + 1] - self._ends[index])
        except OSError as error:  # for example, the disk is gone
            raise _unreadable(path, error) from error
        try:
            line = FrameLine.from_json(text)
        except ValueError as error:
            raise DamagedFrame(f"{self.folder / FRAME_LINES}: line {index + 1} is damaged; {HINT}") from error
        if line.index != index:
            found = f"line {index + 1} is of frame {line.index} instead of {index}"
            raise DamagedFrame(f"{self.folder / FRAME_LINES}: {found}; {HINT}")
        return line

    def clock_time(self, index: int) -> datetime | None:
        """Time of day at which a frame arrived; None if the recording does not tell."""
        try:
            began, began_s = datetime.fromisoformat(self.run["began"]), float(self.run["began_host_s"])
            return began + timedelta(seconds=self.line(index).host_time_s - began_s)
        except (KeyError, TypeError, ValueError, OverflowError):
            return None

    def pixels(self, index: int) -> NDArray[np.uint16]:
        """Pixels of a frame (row, column), counts, read-only; verified if its line can be read."""
        pixels = self._read(PIXELS, index)
        if pixels is None:
            raise DamagedFrame(f"{self.folder}: the pixels of frame {index} are missing; {HINT}")
        expected = None
        with suppress(InputError):
            expected = self.line(index).crc32
        if expected not in {None, checksum(pixels)}:
            raise DamagedFrame(f"{self.folder}: the pixels of frame {index} are not those that were recorded; {HINT}")
        pixels.flags.writeable = False
        return pixels

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Rows and columns of the frames."""
        pixels = self._array(PIXELS)
        if pixels is None:
            raise InputError(f"{self.folder}: the pixels of all frames are missing")
        return pixels.shape

    def is_whole(self, index: int) -> bool:
        """True if all pixels of a frame exist; after a power failure some may not."""
        pixels = self._array(PIXELS)
        return pixels is not None and pixels.is_whole(index)

    def frame(self, index: int) -> Frame:
        """A frame as the camera returned it."""
        line = self.line(index)
        return Frame(
            pixels=self.pixels(index),
            index=line.camera_index,
            camera_time_s=line.camera_time_s,
            host_time_s=line.host_time_s,
            exposure_s=line.exposure_s,
            em_gain=line.em_gain,
        )

    def displacement(self, index: int) -> Floats | None:
        """Live displacement, px, (lenslet_row, lenslet_column, field_mode, xy), before any bias."""
        return self._result("displacement", index)

    def coefficients(self, index: int) -> Floats | None:
        """Live coefficients e_pq, rad, (pupil_mode, field_mode); None if there are none."""
        return self._result("coefficients", index)

    def calibration(self, number: int) -> Calibration:
        """Calibration by its number in the lines; cached."""
        with written_by(self.folder, version_of(self.run)):
            return self._calibrations(number)

    def bias(self, number: int) -> Floats:
        """Bias by its number in the lines, px, (lenslet_row, lenslet_column, field_mode, xy); cached."""
        return self._biases(number)

    def start(self, index: int) -> Floats | None:
        """Live displacement before a frame with the same calibration, where its registration started; None: unknown."""
        calibration = self.line(index).calibration
        for earlier in range(index - 1, max(index - 1 - _MOST_SKIPPED, -1), -1):
            with suppress(DamagedFrame):
                if calibration is None or self.line(earlier).calibration != calibration:
                    return None
                if (found := self._found(calibration, "displacement", earlier)) is not None:
                    return found
        return None

    def _result(self, name: str, index: int) -> Floats | None:
        calibration = self.line(index).calibration
        return None if calibration is None else self._found(calibration, name, index)

    def _found(self, calibration: int, name: str, index: int) -> Floats | None:
        """Live result of a frame, shaped as its name says; None if missing or damaged: svwfs replay finds it again."""
        with suppress(DamagedFrame):
            return self._read(f"{RESULTS.format(calibration)}/{name}", index)
        return None

    def _read(self, name: str, index: int) -> NDArray[Any] | None:
        array = self._array(name)
        return None if array is None else array.read(index)

    def _array(self, name: str) -> FrameArray | None:
        path = self.folder / STORE / name
        found = self._arrays.get(name)
        if found is None:  # it may have appeared since
            try:
                is_there = is_array(path)
            except OSError as error:
                raise _unreadable(path, error) from error
            found = self._arrays[name] = FrameArray(path) if is_there else None
        return found


def _unreadable(path: Path, error: OSError) -> InputError:
    return InputError(f"{path}: cannot be read: {error.strerror or error}")


def selected(text: str | None, count: int, source: Path) -> range:
    """Parse FIRST:END for a source of `count` frames; see `Recording.select`."""
    if not count:
        raise InputError(f"{source}: holds no frame")
    parts = re.fullmatch(r"(-?\d+)?:(-?\d+)?", (":" if text is None else text).replace(" ", ""), re.ASCII)
    if parts is None:
        raise InputError(f"--frames {text}: write FIRST:END, counted from 0, as 0:100, or -10: for the last 10")
    frames = range(count)[int(parts[1] or 0) : int(parts[2] or count)]
    if not frames:
        raise InputError(f'--frames "{text}" selects no frame; {source} has {count}')
    return frames
