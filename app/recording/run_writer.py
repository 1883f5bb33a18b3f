"""Writes one recording, frame by frame: a frame is acknowledged when its line is in `frames.jsonl`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, Generic, TypeVar

import zarr
from numpy.typing import NDArray

from app.errors import InputError, RunError
from app.files import make_folder
from app.measurement.calibration import Calibration
from app.recording.folder import check_free
from app.recording.frame_array import FrameArray, Separator
from app.recording.frame_line import FrameLine
from app.recording.kept_calibration import write_array, write_calibration
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
from app.recording.lock import lock
from app.recording.record import Record
from app.run_facts import now, software_facts, write_record
from reconstruction.arrays import Floats

T = TypeVar("T")

_LENSLET = ("lenslet_row", "lenslet_column")


class RunWriter:
    """One recording that is being written, by one thread."""

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        """Begin a recording in a folder that holds none; `facts` are what `run.json` says of devices and bench."""
        check_free(folder)
        make_folder(folder)
        self._folder = folder
        self._run: dict[str, Any] = {
            "format": FORMAT,
            "complete": False,
            "began": now(),
            "began_host_s": time.perf_counter(),
            **facts,
            **software_facts(),
        }
        self._lines = _claim(folder)
        try:
            write_record(folder / RUN, self._run)
        except BaseException:
            self._lines.close()
            (folder / FRAMES).unlink()
            raise
        self._arrays: dict[str, FrameArray] = {}
        self._calibrations = _Numbered[Calibration](
            lambda number, calibration: write_calibration(calibration_folder(folder, number), calibration)
        )
        self._biases = _Numbered[Floats](lambda number, bias: write_array(bias_file(folder, number), bias))
        self._registered: tuple[int, Floats] | None = None  # the last frame that was: its index and displacement
        self._acknowledged = 0  # bytes of all lines
        self.frames = self.reconstructed = self.lost = self.bytes = 0

    def write(self, record: Record) -> None:
        """Write a frame and, when all of it can be read, acknowledge it."""
        index = self.frames
        calibration, bias = self._calibrations.number_of(record.calibration), self._biases.number_of(record.bias)
        if self._registered is None and record.start is not None:  # the frame before it is not in this recording
            write_array(start_file(self._folder), record.start)
            self._registered = BEFORE, record.start
        start = self._registered[0] if record.start is not None and self._registered is not None else None
        written = self._put(PIXELS, index, record.frame.pixels, ("y", "x"))
        if calibration is not None:
            results = results_of(calibration)
            if record.displacement is not None:
                vectors = (*_LENSLET, "field_mode", "xy")
                written += self._put(f"{results}/displacement", index, record.displacement, vectors)
            if record.coefficients is not None:
                modes = ("pupil_mode", "field_mode")
                written += self._put(f"{results}/coefficients", index, record.coefficients, modes)
        self._acknowledge(_line(record, index, calibration, bias, start))
        if record.displacement is not None:
            self._registered = index, record.displacement
        self.frames += 1
        self.reconstructed += not record.problem
        self.lost += record.lost
        self.bytes += written

    def sync(self) -> None:
        """Have the operating system put the lines where they survive a power cut, too."""
        os.fsync(self._lines.fileno())

    def finish(self, ended_early: str, *, acquired: int, facts: Mapping[str, Any]) -> None:
        """Make it complete: arrays of the right length, and `run.json` with why it ended early and more `facts`.

        So many were `acquired` for it; those that it lacks are among those that could not be written.
        """
        if ended_early:
            self._take_back()
        for array in self._arrays.values():
            array.set_length(self.frames)
        self.sync()
        counts = {"acquired": acquired, "recorded": self.frames, "reconstructed": self.reconstructed, "lost": self.lost}
        ended = {"complete": True, "ended": now(), "ended_early": ended_early, "frames": counts}
        write_record(self._folder / RUN, {**self._run, **ended, **facts})

    def close(self) -> None:
        """Let go of the files, whether it is complete or not."""
        self._lines.close()

    def _take_back(self) -> None:
        """Remove what was written of a frame that was not acknowledged; on a full disk this is the room to finish."""
        for array in self._arrays.values():
            array.remove(self.frames)
        os.ftruncate(self._lines.fileno(), self._acknowledged)

    def _acknowledge(self, line: FrameLine) -> None:
        left = memoryview((line.to_json() + "\n").encode())
        length = len(left)
        while left:
            left = left[self._lines.write(left) :]
        self._acknowledged += length

    def _put(self, name: str, index: int, values: NDArray[Any], dimensions: tuple[str, ...]) -> int:
        if name not in self._arrays:
            if not self._arrays:
                _make_store(self._folder / STORE)
            separator: Separator = "/" if name == PIXELS else "."
            self._arrays[name] = FrameArray.create(self._folder / STORE, name, values, dimensions, separator)
        try:
            return self._arrays[name].write(index, values)
        except RunError as error:
            raise RunError(f"the recording has ended with frame {index}, {name}: {error}") from error


class _Numbered(Generic[T]):
    """Things of which each frame has one, the same for many: written once, when a new one comes, by its number."""

    def __init__(self, write: Callable[[int, T], None]) -> None:
        self._write = write
        self._newest: T | None = None
        self._count = 0

    def number_of(self, thing: T | None) -> int | None:
        """The number by which a frame's line calls it; None where there is none."""
        if thing is None:
            return None
        if thing is not self._newest:
            self._write(self._count, thing)
            self._newest, self._count = thing, self._count + 1
        return self._count - 1


def _claim(folder: Path) -> IO[bytes]:
    """Make the file of lines: of two programs that begin in one folder at once, this refuses the second."""
    try:
        lines = (folder / FRAMES).open("xb", buffering=0)
    except FileExistsError as error:
        raise InputError(f"{folder}: holds a recording already: {FRAMES}") from error
    lock(lines)
    return lines


def _line(record: Record, index: int, calibration: int | None, bias: int | None, start: int | None) -> FrameLine:
    frame, light = record.frame, record.light
    return FrameLine(
        index=index,
        camera_index=frame.index,
        camera_time_s=frame.camera_time_s,
        host_time_s=frame.host_time_s,
        exposure_s=frame.exposure_s,
        em_gain=frame.em_gain,
        is_light_on=None if light is None else light.is_on,
        light_current_a=None if light is None else light.current_a,
        lost=record.lost,
        calibration=calibration,
        bias=bias,
        bias_age_s=record.bias_age_s,
        start=start,
        problem=record.problem,
        rms_rad=record.rms_rad,
        valid=record.valid,
    )


def _make_store(path: Path) -> None:
    """The group, which OME-NGFF 0.5 readers take for an image with one scale."""
    axes = [{"name": "t", "type": "time"}, {"name": "y", "type": "space"}, {"name": "x", "type": "space"}]
    scale = {"path": PIXELS, "coordinateTransformations": [{"type": "scale", "scale": [1.0, 1.0, 1.0]}]}
    multiscales = [{"name": "frames", "axes": axes, "datasets": [scale]}]
    zarr.create_group(path, attributes={"ome": {"version": "0.5", "multiscales": multiscales}})
