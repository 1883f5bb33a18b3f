"""Recordings in the formats of other programs, a function for each format."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from app.bench.config import write_bench
from app.errors import NOTHING_TO_WRITE, SETTINGS_CHANGED, InputError, RunError
from app.files import write_csv
from app.images import write_stack
from app.measurement.measurement import Measurement
from app.progress import Progress, counting
from app.recording.reader import Recording, selected
from app.recording.reprocess import reprocess
from app.results.coefficients import double_zernikes, table_of, zernikes_of_views
from app.results.dataset import result_dataset, results_in_pieces
from app.results.point_spread import psf_grid, psf_reach, write_psf_grid
from app.results.replay import first_bench
from app.results.result_file import reading_results, write_pieces
from reconstruction.arrays import Floats
from reconstruction.modes.polynomials import ZernikeOrder
from reconstruction.quality.verdict import Quality
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront, rms

if TYPE_CHECKING:
    import xarray as xr

_REACH_FRAMES = 50  # evenly spaced frames that set the angular range of the point-spread functions


def _write_tiff(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    lines = [recording.line(index) for index in chosen]
    time_s = np.array([line.camera_time_s for line in lines])
    bench = first_bench(recording, chosen)
    write_stack(
        out,
        counting((recording.pixels(index) for index in chosen), len(chosen), progress, "writing frames"),
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
    """Write a row of numbers for each frame, NaN without a wavefront; columns have names and units.

    `clock_time` is the time of day at which the frame arrived, ISO 8601. `rms_R_C_rad` is the RMS at view row R, view
    column C; `e_P_Q_rad` the coefficient of pupil mode P and field mode Q, and `e_P_Q_sigma_rad` its standard deviation
    (modal method only).
    """
    remaining = _reconstructed(recording, chosen, progress)
    before: list[Measurement] = []  # up to the first with a wavefront, which decides the columns
    for frame in remaining:
        before.append(frame)
        if frame.wavefront is not None:
            break
    else:
        raise RunError(f"{out}: {NOTHING_TO_WRITE}")
    names = list(_values(frame.wavefront))
    first = ("frame", "camera_frame", "time_s", "clock_time", "exposure_s", "em_gain", "valid_lenslets")
    write_csv(out, [*first, *names], (_row(recording, each, names) for each in chain(before, remaining)))


def _row(recording: Recording, frame: Measurement, names: list[str]) -> list[float | str]:
    taken, values = frame.frame, dict.fromkeys(names, np.nan)
    if frame.wavefront is not None:
        values = _values(frame.wavefront)
        if list(values) != names:
            raise InputError(SETTINGS_CHANGED)
    valid = 0 if frame.registered is None else int(frame.registered.valid.sum())
    clock = recording.clock_time(frame.index)
    times = taken.index, taken.camera_time_s, "" if clock is None else clock.isoformat(timespec="milliseconds")
    return [frame.index, *times, taken.exposure_s, taken.em_gain, valid, *values.values()]


_COLUMNS = {  # of a table of results, by variable; the indices of a view or of modes stand for {}
    "frame_index": "camera_frame",
    "time": "time_s",
    "valid": "valid_lenslets",
    "rms": "rms{}_rad",
    "coefficients": "e{}_rad",
    "coefficients_sigma": "e{}_sigma_rad",
}


def write_results_csv(source: Path, out: Path, frames: str | None) -> int:
    """Write the same columns for each frame of a results file, as far as it has them; return the number of frames."""
    with reading_results(source) as opened:
        stacked = opened if "frame" in opened.dims else opened.expand_dims("frame")
        chosen = selected(frames, stacked.sizes["frame"], source)
        columns: dict[str, list[object]] = {"frame": list(chosen)}
        for name in (each for each in _COLUMNS if each in stacked.variables):
            values = stacked[name].transpose("frame", ...).values[chosen]
            values = values.sum(axis=(1, 2)) if name == "valid" else values
            for at in np.ndindex(values.shape[1:]):
                columns[_COLUMNS[name].format("".join(f"_{index}" for index in at))] = values[:, *at].tolist()
    write_csv(out, list(columns), zip(*columns.values(), strict=True))
    return len(chosen)


def _values(wavefront: Wavefront) -> dict[str, float]:
    values = {f"rms_{row}_{column}_rad": float(value) for (row, column), value in np.ndenumerate(rms(wavefront.views))}
    if isinstance(wavefront.solution, ModalSolution):
        for name, modes in (("", wavefront.solution.coefficients), ("_sigma", wavefront.solution.coefficients_sigma)):
            for (pupil_mode, field_mode), value in np.ndenumerate(modes):
                values[f"e_{pupil_mode}_{field_mode}{name}_rad"] = float(value)
    return values


def _write_results(
    recording: Recording,
    chosen: range,
    out: Path,
    progress: Progress,
    results_of: Callable[[Wavefront, Quality], xr.Dataset] = result_dataset,
) -> None:
    pieces = results_in_pieces(((frame, {}) for frame in _reconstructed(recording, chosen, progress)), results_of)
    write_pieces(out, pieces, bench=first_bench(recording, chosen), inputs={"recording": recording.folder.name})


def write_zernike_table(
    recording: Recording, chosen: range, out: Path, progress: Progress, order: ZernikeOrder = "noll"
) -> None:
    """Write one row of numbers for each frame with a wavefront, and view inside the field."""
    frames = _reconstructed(recording, chosen, progress)
    known = ((frame.index, frame.wavefront) for frame in frames if frame.wavefront is not None)
    tables = ((index, *table_of(zernikes_of_views(wavefront, order))) for index, wavefront in known)
    first = next(tables, None)
    if first is None:
        raise RunError(f"{out}: {NOTHING_TO_WRITE}")

    def rows() -> Iterator[list[float]]:
        for index, names, of_frame in chain([first], tables):
            if names != first[1]:
                raise InputError(SETTINGS_CHANGED)
            yield from ([index, *row] for row in of_frame)

    write_csv(out, ["frame", *first[1]], rows())


def _write_psf(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    bench = first_bench(recording, chosen)
    some = chosen[:: max(1, len(chosen) // _REACH_FRAMES)]
    reach_rad = psf_reach(_views(recording, some, progress, "finding the angular range"), bench.sensor)
    if np.isnan(reach_rad):
        raise RunError(f"{out}: {NOTHING_TO_WRITE}")
    grid = psf_grid(_views(recording, chosen, progress, "adding point-spread functions"), bench.sensor, reach_rad)
    about = {"recording": recording.folder.name, "frames": [chosen.start, chosen.stop], "bench": write_bench(bench)}
    write_psf_grid(out, grid, bench.field, about)


def _views(recording: Recording, chosen: range, progress: Progress, text: str) -> Iterator[Floats]:
    frames = _reconstructed(recording, chosen, progress, text)
    return (frame.wavefront.views for frame in frames if frame.wavefront is not None)


def _reconstructed(
    recording: Recording, chosen: range, progress: Progress, text: str = "reconstructing frames"
) -> Iterator[Measurement]:
    return counting(reprocess(recording, chosen), len(chosen), progress, text)


EXPORT_WRITERS: dict[str, Callable[[Recording, range, Path, Progress], None]] = {
    "tiff": _write_tiff,
    "csv": _write_csv,
    "netcdf": _write_results,
    "psf": _write_psf,
    "double-zernike": partial(_write_results, results_of=double_zernikes),
    "zernike-table": write_zernike_table,
}
