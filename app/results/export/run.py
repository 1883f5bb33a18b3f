"""Recordings in the formats of other programs: what `svwfs export` does."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from app.bench.config import write_bench
from app.errors import InputError, RunError
from app.progress import Progress
from app.recording.reader import Recording
from app.recording.reprocess import reprocess
from app.results.dataset import write_pieces
from app.results.export.imagej import write_stack
from app.results.export.psf_grid import psf_grid, psf_reach, write_psf_grid
from app.results.export.table import write_table
from app.results.replay.results import results_in_pieces
from app.results.replay.run import first_bench
from reconstruction.arrays import Floats
from reconstruction.runtime.threads import one_blas_thread

T = TypeVar("T")

Format = Literal["tiff", "csv", "netcdf", "psf"]

_LOOKED_AT = 50  # frames, spread evenly, that tell how far the light of all of them reaches


def export(folder: Path, to: Format, out: Path, *, frames: str | None, overwrite: bool, progress: Progress) -> int:
    """Write frames of a recording, or what its own bench makes of them, to a file; return how many were meant.

    A file that is there is left as it is unless it may be overwritten.
    """
    if out.exists() and not overwrite:
        raise InputError(f"{out}: is there already; --overwrite replaces it")
    recording = Recording(folder)
    chosen = recording.select(frames)
    with one_blas_thread():
        _WRITERS[to](recording, chosen, out, progress)
    return len(chosen)


def _write_tiff(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    lines = [recording.line(index) for index in chosen]
    time_s = np.array([line.camera_time_s for line in lines])
    bench = first_bench(recording, chosen)
    write_stack(
        out,
        _reported((recording.pixels(index) for index in chosen), len(chosen), progress, "writing frames"),
        labels=[
            f"frame {line.index}: t = {line.camera_time_s:.6f} s, exposure {line.exposure_s * 1e3:g} ms,"
            f" em gain {line.em_gain:g}"
            for line in lines
        ],
        information=write_bench(bench),
        pixel_um=bench.sensor.pixel_pitch_m * 1e6,
        interval_s=float(np.median(np.diff(time_s))) if len(lines) > 1 else 0.0,
    )


def _write_csv(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    write_table(out, _reported(reprocess(recording, chosen), len(chosen), progress, "reconstructing frames"))


def _write_netcdf(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    frames = _reported(reprocess(recording, chosen), len(chosen), progress, "reconstructing frames")
    bench, inputs = first_bench(recording, chosen), {"recording": recording.folder.name}
    write_pieces(out, results_in_pieces((frame, {}) for frame in frames), bench=bench, inputs=inputs)


def _write_psf(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    bench = first_bench(recording, chosen)
    some = chosen[:: max(1, len(chosen) // _LOOKED_AT)]
    reach_rad = psf_reach(_views(recording, some, progress, "looking how far the light reaches"), bench.sensor)
    if np.isnan(reach_rad):
        raise RunError(f"{out}: there is nothing to write: no frame has a wavefront")
    grid = psf_grid(_views(recording, chosen, progress, "adding point-spread functions"), bench.sensor, reach_rad)
    about = {"recording": recording.folder.name, "frames": [chosen.start, chosen.stop], "bench": write_bench(bench)}
    write_psf_grid(out, grid, bench.field, about)


def _views(recording: Recording, chosen: range, progress: Progress, text: str) -> Iterator[Floats]:
    """The wavefronts of those frames that have one."""
    for frame in _reported(reprocess(recording, chosen), len(chosen), progress, text):
        if frame.wavefront is not None:
            yield frame.wavefront.views


def _reported(items: Iterable[T], count: int, progress: Progress, text: str) -> Iterator[T]:
    """Tell how many have passed."""
    for done, item in enumerate(items, 1):
        yield item
        progress(text, done / count)


_WRITERS = {"tiff": _write_tiff, "csv": _write_csv, "netcdf": _write_netcdf, "psf": _write_psf}
