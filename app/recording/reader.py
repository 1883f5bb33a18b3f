"""Reads a recording: a finished one, one that was cut short by whatever, or one that is still growing.

What `frames.jsonl` names is there; a last line without an end is not yet. Nothing is changed on the disk, and memory
stays flat however many frames there are.
"""

from __future__ import annotations

import json
from array import array
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench, parse_bench
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.frame_array import FrameArray, is_array
from app.recording.frame_line import FrameLine
from app.recording.kept_calibration import read_calibration
from app.recording.layout import (
    BEFORE,
    FORMAT,
    FRAMES,
    PIXELS,
    RUN,
    STORE,
    bias_file,
    calibration_folder,
    results_of,
    start_file,
)
from drivers.interface import Frame
from reconstruction.arrays import Floats

_PIECE = 1 << 20  # bytes read at once
_TELLS = "svwfs recover tells which frames are whole"


class Recording:
    """One recording, by its folder; whatever is wrong with it is an `InputError` of one sentence."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self.run = read_run(self.folder)
        self._ends = array("q", [0])  # where each line ends, bytes; the first number is where the first begins
        self._arrays: dict[str, FrameArray | None] = {}
        self._calibrations = lru_cache(maxsize=4)(
            lambda number: read_calibration(calibration_folder(self.folder, number))
        )
        self._biases = lru_cache(maxsize=4)(lambda number: _load(bias_file(self.folder, number)))
        self.refresh()

    def __len__(self) -> int:
        return len(self._ends) - 1

    def refresh(self) -> int:
        """Look for frames that have come since, and whether it is complete now; return how many there are."""
        try:
            with (self.folder / FRAMES).open("rb") as file:
                file.seek(self._ends[-1])
                while piece := file.read(_PIECE):
                    after = file.tell() - len(piece) + 1
                    self._ends.extend((np.flatnonzero(np.frombuffer(piece, np.uint8) == ord("\n")) + after).tolist())
        except FileNotFoundError:  # it has only just begun
            pass
        except OSError as error:
            raise InputError(f"{self.folder / FRAMES}: cannot be read: {error.strerror or error}") from error
        if not self.is_complete:
            self.run = read_run(self.folder)
        return len(self)

    @property
    def is_complete(self) -> bool:
        """Whether it was finished; else it still grows, or its program has died and `svwfs recover` finishes it."""
        return bool(self.run["complete"])

    @property
    def ended_early(self) -> str:
        """Why it ended before it was to; empty when it did not."""
        return str(self.run.get("ended_early", ""))

    @property
    def bench(self) -> Bench:
        """The bench as it was when it began; each calibration has its own, with the lattice in force."""
        return parse_bench(str(self.run["bench"]), f"{self.folder / RUN}: bench")

    def line(self, index: int) -> FrameLine:
        """What there is to say of a frame."""
        if not 0 <= index < len(self):
            raise InputError(f"{self.folder}: has no frame {index}; it has {len(self)}")
        try:
            with (self.folder / FRAMES).open("rb") as file:
                file.seek(self._ends[index])
                text = file.read(self._ends[index + 1] - self._ends[index])
        except OSError as error:  # the folder was on a disk that is gone
            raise InputError(f"{self.folder / FRAMES}: cannot be read: {error.strerror or error}") from error
        try:
            line = FrameLine.from_json(text)
        except ValueError as error:
            raise InputError(f"{self.folder / FRAMES}: line {index + 1} is damaged; {_TELLS}") from error
        if line.index != index:
            said = f"line {index + 1} is of frame {line.index} instead of {index}"
            raise InputError(f"{self.folder / FRAMES}: {said}; {_TELLS}")
        return line

    def pixels(self, index: int) -> NDArray[np.uint16]:
        """A frame's pixels (row, column), counts."""
        pixels = self._read(PIXELS, index)
        if pixels is None:
            raise InputError(f"{self.folder}: the pixels of frame {index} are missing")
        pixels.flags.writeable = False
        return pixels

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Rows and columns of all frames, whether or not they are whole."""
        pixels = self._array(PIXELS)
        if pixels is None:
            raise InputError(f"{self.folder}: the pixels of all frames are missing")
        return pixels.shape

    def is_whole(self, index: int) -> bool:
        """Whether all pixels of a frame are there; they are, unless a power cut took them."""
        pixels = self._array(PIXELS)
        return pixels is not None and pixels.is_whole(index)

    def has_results(self, line: FrameLine) -> bool:
        """Whether what was found live is there, if anything was."""
        if line.calibration is None or line.problem:
            return True
        group = results_of(line.calibration)
        displacement, coefficients = self._array(f"{group}/displacement"), self._array(f"{group}/coefficients")
        if displacement is None or not displacement.is_whole(line.index):
            return False
        return coefficients is None or coefficients.is_whole(line.index)  # None: of the zonal method

    def frame(self, index: int) -> Frame:
        """A frame as it left the camera."""
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
        """How a frame was registered, px, (lenslet_row, lenslet_column, field_mode, xy); None if it was not."""
        return self._result("displacement", index)

    def coefficients(self, index: int) -> Floats | None:
        """The coefficients e_pq of a frame, rad, (pupil_mode, field_mode); None if it was not reconstructed so."""
        return self._result("coefficients", index)

    def calibration(self, number: int) -> Calibration:
        """The calibration that lines call by this number; the same object while it is wanted."""
        return self._calibrations(number)

    def bias(self, number: int) -> Floats:
        """The bias that lines call by this number, px, (lenslet_row, lenslet_column, field_mode, xy)."""
        return self._biases(number)

    def start(self, index: int) -> Floats | None:
        """Where the registration of a frame began, px, as `displacement`; None when it began cold."""
        line = self.line(index)
        if line.start is None:
            return None
        if line.start == BEFORE:
            return _load(start_file(self.folder))
        if line.calibration is None:
            return None
        return self._read(f"{results_of(line.calibration)}/displacement", line.start)  # of the same, always

    def _result(self, name: str, index: int) -> Floats | None:
        calibration = self.line(index).calibration
        return None if calibration is None else self._read(f"{results_of(calibration)}/{name}", index)

    def _read(self, name: str, index: int) -> NDArray[Any] | None:
        found = self._array(name)
        return None if found is None else found.read(index)

    def _array(self, name: str) -> FrameArray | None:
        if self._arrays.get(name) is None:  # or it was not there when it was looked for last
            path = self.folder / STORE / name
            self._arrays[name] = FrameArray(path) if is_array(path) else None
        return self._arrays[name]


def _load(path: Path) -> Floats:
    try:
        values: Floats = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    return values


def read_run(folder: Path) -> dict[str, Any]:
    """What `run.json` says; `InputError` when the folder holds no recording."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder" if not folder.exists() else f"{folder}: is no folder")
    path = folder / RUN
    try:
        run = json.loads(path.read_text("utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{folder}: holds no recording: there is no {RUN} in it") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if not isinstance(run, dict) or run.get("format") != FORMAT or "complete" not in run or "bench" not in run:
        raise InputError(f"{path}: is not that of a recording ({FORMAT})")
    return run
