"""One frame of a recording, reconstructed, or of a results file, with plausible numbers."""

from pathlib import Path

import numpy as np
import xarray as xr

from app.bench.config import Bench, parse_bench
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.reader import Recording
from app.recording.reprocess import reprocess
from app.results.dataset import reading_results
from reconstruction.arrays import Floats
from reconstruction.wavefront import Wavefront

_LARGEST_RAD = 1e6  # of a coefficient: displacements of thousands of pixels


def recorded_frame(folder: Path, frame: int) -> tuple[Calibration, Wavefront]:
    """Reconstruct one frame of a recording, counted from 0; `InputError` if there is none, or it has no wavefront."""
    recording = Recording(folder)
    _require_frame(folder, frame, len(recording))
    (made,) = reprocess(recording, [frame])
    if made.wavefront is None or made.calibration is None:
        raise InputError(f"{folder}: frame {frame} has no wavefront: {made.problem}")
    return made.calibration, made.wavefront


def stored_frame(path: Path, frame: int, *names: str) -> tuple[Bench, xr.Dataset]:
    """Return the bench, and the variables `names` and the coefficients of one frame, counted from 0, of a results file.

    Raises `InputError` if there is no such frame or variable, or no measurement can have given the coefficients.
    """
    with reading_results(path) as opened:
        if "coefficients" not in opened:
            raise InputError(f"{path}: holds no coefficients: reconstruct with reconstruction.method=modal")
        if missing := [name for name in names if name not in opened]:
            raise InputError(f"{path}: is damaged: it lacks {', '.join(missing)}")
        results = opened[["coefficients", *names]]
        results = results if "frame" in results.dims else results.expand_dims("frame")
        _require_frame(path, frame, results.sizes["frame"])
        bench = parse_bench(str(opened.attrs.get("bench", "")), f"{path}: bench", is_recorded=True)
        one = results.isel(frame=frame).load()
    require_plausible(path, one["coefficients"].values)
    return bench, one


def require_plausible(path: Path, coefficients: Floats) -> None:
    """Raise `InputError` unless a measurement can have given coefficients e_pq, rad."""
    if not (np.abs(coefficients) < _LARGEST_RAD).all():  # nor is NaN
        worst = np.max(np.abs(coefficients))
        raise InputError(f"{path}: is damaged: it has a coefficient of {worst:g} rad, which no wavefront has")


def _require_frame(source: Path, frame: int, count: int) -> None:
    if not 0 <= frame < count:
        raise InputError(f"{source}: there is no frame {frame}; frames are counted from 0, their number is {count}")
