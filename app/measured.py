"""The results of a recording: `results.nc` beside it, made piece by piece, so that memory does not grow with them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice

import numpy as np
import xarray as xr

from app.config import Bench
from app.files import write_image
from app.progress import Report
from app.recording.frame_line import FrameLine
from app.recording.reader import Recording
from app.recording.repeat import repeated
from app.results import result_dataset, stack_frames, write_pieces
from reconstruction.geometry import Floats
from reconstruction.wavefront import Wavefront, rms

_PIECE = 32  # frames in memory


@dataclass(slots=True)
class Measured:
    """What there is to say of all frames together."""

    bench: Bench
    mean_rms_rad: Floats  # of each view, over the frames, (view_row, view_column)
    square_rms_rad: Floats  # likewise the mean of the squares, rad^2
    recorded: int = 0
    reconstructed: int = 0
    lost: int = 0  # by the camera
    problem: str = ""  # of the first frame that could not be reconstructed; empty when all could

    @property
    def scatter_rms_rad(self) -> Floats:
        """Standard deviation of each view's RMS over the frames, rad, (view_row, view_column)."""
        return np.sqrt(np.maximum(self.square_rms_rad - self.mean_rms_rad**2, 0))

    def take(self, line: FrameLine, wavefront: Wavefront | None, problem: str) -> None:
        """Take one more frame into account."""
        self.recorded, self.lost = self.recorded + 1, self.lost + line.lost
        if wavefront is None:
            self.problem = self.problem or problem
            return
        self.reconstructed += 1
        values = rms(wavefront.views)
        self.mean_rms_rad = self.mean_rms_rad + (values - self.mean_rms_rad) / self.reconstructed
        self.square_rms_rad = self.square_rms_rad + (values**2 - self.square_rms_rad) / self.reconstructed


def write_measured(recording: Recording, bench: Bench, report: Report) -> Measured:
    """Write `results.nc`, `dark.tif` and `reference.tif` into a recording's folder, and say what came out.

    Every frame is reconstructed, also those that were passed over live. Without any there is no `results.nc`.
    """
    shape = bench.field.view_rows, bench.field.view_columns
    measured = Measured(bench, np.zeros(shape), np.zeros(shape))
    _write_calibration(recording)
    results = _results(recording, measured, report)
    first = next(results, None)
    if first is not None:
        pieces = _stacked(chain([first], results), bench)
        names = {"dark": "dark.tif", "reference": "reference.tif"}
        write_pieces(recording.folder / "results.nc", pieces, bench=bench, inputs=names)
    return measured


def _write_calibration(recording: Recording) -> None:
    """Write dark and reference of the first calibration as images."""
    if len(recording) and (number := recording.line(0).calibration) is not None:
        calibration = recording.calibration(number)
        for name, average in (("dark", calibration.dark), ("reference", calibration.reference)):
            if average is not None:
                write_image(recording.folder / f"{name}.tif", average.mean)


def _results(recording: Recording, measured: Measured, report: Report) -> Iterator[tuple[FrameLine, Wavefront]]:
    """Every frame that yields a wavefront; all are counted as they come."""
    for made in repeated(recording):
        measured.take(made.line, made.wavefront, made.problem)
        report("writing the results", (made.line.index + 1) / len(recording))
        if made.wavefront is not None:
            yield made.line, made.wavefront


def _stacked(results: Iterator[tuple[FrameLine, Wavefront]], bench: Bench) -> Iterator[xr.Dataset]:
    """The results of some frames after one another, again and again."""
    while piece := list(islice(results, _PIECE)):
        yield stack_frames(
            [result_dataset(wavefront, bench) for _, wavefront in piece],
            [line.camera_index for line, _ in piece],
            [line.camera_time_s for line, _ in piece],
            [math.nan if line.bias_age_s is None else line.bias_age_s for line, _ in piece],
        )
