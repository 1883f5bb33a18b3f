"""Writer of recordings: a frame counts once its line is in `frames.jsonl`."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from app.errors import InputError, RunError
from app.files import make_folder, reachable, sync
from app.measurement.measurement import Gap, Measurement
from app.recording.calibration_files import write_array, write_calibration
from app.recording.folder import (
    BIAS,
    CALIBRATION,
    CALIBRATIONS,
    FORMAT,
    FRAME_LINES,
    PIXELS,
    RESULTS,
    RUN,
    STORE,
    check_free,
    lock,
)
from app.recording.frame_array import FrameArray, append, make_group
from app.recording.frame_lines import FrameLine, checksum, sample_line
from app.run_facts import now, software_facts, write_record
from reconstruction.arrays import Floats
from reconstruction.wavefront import mean_rms

T = TypeVar("T")

_AXES = [{"name": "t", "type": "time"}, {"name": "y", "type": "space"}, {"name": "x", "type": "space"}]
_SCALE = {"path": PIXELS, "coordinateTransformations": [{"type": "scale", "scale": [1.0, 1.0, 1.0]}]}
_IMAGE = {"name": "frames", "axes": _AXES, "datasets": [_SCALE]}  # of OME-NGFF, with one scale


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Recorded part of a `Measurement`; 10 s of them fit in memory, because they hold no covariance."""

    made: Measurement  # without wavefront and displacements
    displacement: Floats | None = None  # px, (lenslet_row, lenslet_column, field_mode, xy)
    coefficients: Floats | None = None  # rad, (pupil_mode, field_mode)
    rms_rad: float = math.nan  # of the wavefront, mean over the views, which themselves are not recorded
    valid: int | None = None
    absorbs: bool | None = None

    @classmethod
    def of(cls, measurement: Measurement) -> Record:
        """Take the recorded parts of a measurement, without a copy."""
        wavefront, registered = measurement.wavefront, measurement.registered
        return cls(
            replace(measurement, wavefront=None, registered=None),
            displacement=None if registered is None else registered.coefficients,
            coefficients=None if wavefront is None else wavefront.coefficients,
            rms_rad=math.nan if wavefront is None else mean_rms(wavefront.views),
            valid=None if registered is None else int(np.count_nonzero(registered.valid)),
            absorbs=None if registered is None else registered.absorbs,
        )

    @property
    def nbytes(self) -> int:
        """Memory of the arrays that belong to this record alone."""
        arrays = (self.made.frame.pixels, self.displacement, self.coefficients)
        return sum(array.nbytes for array in arrays if array is not None)

    def line(self, index: int, *, calibration: int | None, bias: int | None) -> FrameLine:
        """Line of the frame at an `index`, with the numbers of what it refers to."""
        made, frame, light = self.made, self.made.frame, self.made.light
        sample, refinement, _ = made.assumed
        gap = made.gap if index else None  # one before the first frame is none of this recording
        return FrameLine(
            index=index,
            camera_index=frame.index,
            camera_time_s=frame.camera_time_s,
            host_time_s=frame.host_time_s,
            exposure_s=frame.exposure_s,
            em_gain=frame.em_gain,
            is_light_on=None if light is None else light.is_on,
            light_current_a=None if light is None else light.current_a,
            lost=made.lost,
            calibration=calibration,
            bias=bias,
            bias_age_s=None if refinement.bias is None else refinement.age_s,
            problem=made.problem,
            rms_rad=None if math.isnan(self.rms_rad) else self.rms_rad,  # JSON has no NaN
            valid=self.valid,
            sample=None if sample is None else sample_line(sample),
            crc32=checksum(frame.pixels),
            gap_s=0.0 if gap is None else gap.seconds,
            gap_cause="" if gap is None else gap.cause,
            absorbs=self.absorbs,
        )


class RecordingWriter:
    """Writes one recording, from one thread; `facts` of bench and devices go into `run.json`."""

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        folder = reachable(folder)
        check_free(folder)
        make_folder(folder)
        sync(folder.parent)
        self._folder = folder
        self._run: dict[str, Any] = {
            "format": FORMAT,
            "complete": False,
            "began": now(),
            "began_host_s": time.perf_counter(),
            **facts,
            **software_facts(),
        }
        self._lines = _create_lines(folder)
        try:
            write_record(folder / RUN, self._run)
        except BaseException:
            self._lines.close()
            (folder / FRAME_LINES).unlink()
            raise
        self._arrays: dict[str, FrameArray] = {}
        make_group(folder / STORE, {"ome": {"version": "0.5", "multiscales": [_IMAGE]}})
        self._newest: dict[str, tuple[Any, int]] = {}  # calibration and bias, with their numbers
        self._lines_bytes = 0
        self.gaps: list[Gap] = []
        self.frames = self.reconstructed = self.lost = 0

    def write(self, record: Record) -> None:
        """Write a frame, and then its line."""
        index, made = self.frames, record.made
        calibration = self._number_of(made.calibration, CALIBRATION, write_calibration)
        bias = self._number_of(made.assumed.refinement.bias, BIAS, write_array)
        for name, array, values in self._parts(record, calibration):
            try:
                array.write(index, values)
            except RunError as error:
                raise RunError(f"the recording has ended with frame {index}, {name}: {error}") from error
        line = record.line(index, calibration=calibration, bias=bias).to_json().encode() + b"\n"
        append(self._lines, line)
        self._lines_bytes += len(line)
        self.frames += 1
        self.reconstructed += not made.problem
        self.lost += made.lost
        if made.gap is not None and index:
            self.gaps.append(made.gap)

    def prepare(self, record: Record) -> None:
        """Make what frames like this one need; without frames, `finish` removes it."""
        for _ in self._parts(record, self._number_of(record.made.calibration, CALIBRATION, write_calibration)):
            pass

    def sync(self) -> None:
        """Force the lines to disk, so that they survive a power failure."""
        os.fsync(self._lines.fileno())

    def finish(self, ended_early: str, *, acquired: int, facts: Mapping[str, Any]) -> None:
        """Set the length of the arrays, complete `run.json` with `facts` and frames `acquired`; `RunError` if gone."""
        lines = self._folder / FRAME_LINES  # if it is not where it was, no empty recording may take its place
        if not lines.exists() or not os.path.samestat(os.fstat(self._lines.fileno()), lines.stat()):
            raise RunError(f"{lines}: was removed or renamed during the recording; svwfs recover finishes it")
        if ended_early:  # parts of a frame without a line; on a full disk their removal makes space for the rest
            for array in self._arrays.values():
                array.remove(self.frames)
            os.ftruncate(self._lines.fileno(), self._lines_bytes)
        for array in self._arrays.values():
            array.finish(self.frames)
        if not self.frames:
            for prepared in (STORE, CALIBRATIONS):
                shutil.rmtree(self._folder / prepared, ignore_errors=True)
        self.sync()
        counts = {"acquired": acquired, "recorded": self.frames, "reconstructed": self.reconstructed, "lost": self.lost}
        ended = {"complete": True, "ended": now(), "ended_early": ended_early, "frames": counts}
        write_record(self._folder / RUN, {**self._run, **ended, **facts})

    def close(self) -> None:
        """Close the files."""
        for array in self._arrays.values():
            array.close()
        self._lines.close()

    def _number_of(self, item: T | None, name: str, write: Callable[[Path, T], None]) -> int | None:
        """Number an object that many frames share; a new one is written."""
        if item is None:
            return None
        newest, number = self._newest.get(name, (None, -1))
        if item is not newest:
            number += 1
            write(self._folder / name.format(number), item)
            self._newest[name] = item, number
        return number

    def _parts(self, record: Record, calibration: int | None) -> Iterator[tuple[str, FrameArray, NDArray[Any]]]:
        """Yield the names, arrays and values of a record; new arrays are made."""
        parts: list[tuple[str, NDArray[Any] | None]] = [(PIXELS, record.made.frame.pixels)]
        if calibration is not None:
            results = RESULTS.format(calibration)
            parts += (f"{results}/displacement", record.displacement), (f"{results}/coefficients", record.coefficients)
        for name, values in parts:
            if values is not None:
                if (array := self._arrays.get(name)) is None:
                    array = self._arrays[name] = FrameArray.create(self._folder / STORE, name, values)
                yield name, array, values


def _create_lines(folder: Path) -> IO[bytes]:
    """Create and lock `frames.jsonl`; refused to the second of two programs that begin at the same moment."""
    try:
        lines = (folder / FRAME_LINES).open("ab", buffering=0)
    except FileExistsError as error:
        raise InputError(f"{folder}: holds a recording already: {FRAME_LINES}") from error
    try:
        lock(lines)
        check_free(folder)
    except (InputError, RunError):
        lines.close()
        raise
    return lines
