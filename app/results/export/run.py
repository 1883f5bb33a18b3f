"""`svwfs export`: a recording in the formats of other programs."""

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from app.bench.config import write_bench
from app.errors import SETTINGS_CHANGED, InputError, RunError
from app.files import check_outputs, check_suffix
from app.progress import Progress
from app.recording.folder import parts_of
from app.recording.reader import Recording
from app.recording.reprocess import Reprocessed, reprocess
from app.results.dataset import results_in_pieces, write_pieces
from app.results.export.images import psf_grid, psf_reach, write_psf_grid, write_stack
from app.results.export.zernikes import double_zernikes, zernike_names, zernike_rows
from app.results.field.table import write_table
from app.results.replay.run import first_bench
from reconstruction.arrays import Floats
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.solve.modal_solution import ModalSolution
from reconstruction.wavefront import Wavefront, rms

T = TypeVar("T")

Format = Literal["tiff", "csv", "netcdf", "psf", "double-zernike", "zernike-table"]

_REACH_FRAMES = 50  # evenly spaced frames that set the angular range of the point-spread functions


def export(folder: Path, to: Format, out: Path, *, frames: str | None, overwrite: bool, progress: Progress) -> int:
    """Write the frames FIRST:END of a recording, or their results, to a file; return their number."""
    check_outputs([out], inputs=parts_of(folder), overwrite=overwrite)
    check_suffix(out, *_SUFFIXES[to])
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
        _counted((recording.pixels(index) for index in chosen), len(chosen), progress, "writing frames"),
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
    """Write one row of numbers for each frame, NaN without a wavefront; the header names each column with its unit.

    `rms_R_C_rad` is the RMS at view row R, view column C; `e_P_Q_rad` the coefficient of pupil mode P and field mode
    Q, and `e_P_Q_sigma_rad` its standard deviation (modal method only).
    """
    remaining = _counted(reprocess(recording, chosen), len(chosen), progress, "reconstructing frames")
    before: list[Reprocessed] = []  # up to the first with a wavefront, which decides the columns
    for frame in remaining:
        before.append(frame)
        if frame.wavefront is not None:
            break
    else:
        raise RunError(f"{out}: there is nothing to write: no frame has a wavefront")
    names = list(_values(frame.wavefront))
    first = ("frame", "camera_frame", "time_s", "exposure_s", "em_gain", "valid_lenslets")
    write_table(out, [*first, *names], (_row(each, names) for each in chain(before, remaining)))


def _row(frame: Reprocessed, names: list[str]) -> list[float]:
    line, values = frame.line, dict.fromkeys(names, np.nan)
    if frame.wavefront is not None:
        values = _values(frame.wavefront)
        if list(values) != names:
            raise InputError(SETTINGS_CHANGED)
    valid = 0 if frame.registered is None else int(frame.registered.valid.sum())
    return [line.index, line.camera_index, line.camera_time_s, line.exposure_s, line.em_gain, valid, *values.values()]


def _values(wavefront: Wavefront) -> dict[str, float]:
    """Columns of a wavefront."""
    values = {f"rms_{row}_{column}_rad": float(value) for (row, column), value in np.ndenumerate(rms(wavefront.views))}
    if isinstance(wavefront.solution, ModalSolution):
        for name, modes in (("", wavefront.solution.coefficients), ("_sigma", wavefront.solution.coefficients_sigma)):
            for (pupil_mode, field_mode), value in np.ndenumerate(modes):
                values[f"e_{pupil_mode}_{field_mode}{name}_rad"] = float(value)
    return values


def _write_netcdf(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    frames = _counted(reprocess(recording, chosen), len(chosen), progress, "reconstructing frames")
    bench, inputs = first_bench(recording, chosen), {"recording": recording.folder.name}
    write_pieces(out, results_in_pieces((frame, {}) for frame in frames), bench=bench, inputs=inputs)


def _write_double_zernike(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    frames = _counted(reprocess(recording, chosen), len(chosen), progress, "reconstructing frames")
    bench, inputs = first_bench(recording, chosen), {"recording": recording.folder.name}
    pieces = results_in_pieces(((frame, {}) for frame in frames), double_zernikes)
    write_pieces(out, pieces, bench=bench, inputs=inputs)


def _write_zernike_table(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    """Write one row of numbers for each frame with a wavefront, and view inside the field."""
    frames = _counted(reprocess(recording, chosen), len(chosen), progress, "reconstructing frames")
    found = ((frame.line.index, frame.wavefront) for frame in frames if frame.wavefront is not None)
    first = next(found, None)
    if first is None:
        raise RunError(f"{out}: there is nothing to write: no frame has a wavefront")
    names = zernike_names(first[1])
    write_table(out, names, chain.from_iterable(zernike_rows(*each, names) for each in chain([first], found)))


def _write_psf(recording: Recording, chosen: range, out: Path, progress: Progress) -> None:
    bench = first_bench(recording, chosen)
    some = chosen[:: max(1, len(chosen) // _REACH_FRAMES)]
    reach_rad = psf_reach(_views(recording, some, progress, "finding the angular range"), bench.sensor)
    if np.isnan(reach_rad):
        raise RunError(f"{out}: there is nothing to write: no frame has a wavefront")
    grid = psf_grid(_views(recording, chosen, progress, "adding point-spread functions"), bench.sensor, reach_rad)
    about = {"recording": recording.folder.name, "frames": [chosen.start, chosen.stop], "bench": write_bench(bench)}
    write_psf_grid(out, grid, bench.field, about)


def _views(recording: Recording, chosen: range, progress: Progress, text: str) -> Iterator[Floats]:
    """Wavefronts of the frames that have one."""
    for frame in _counted(reprocess(recording, chosen), len(chosen), progress, text):
        if frame.wavefront is not None:
            yield frame.wavefront.views


def _counted(items: Iterable[T], count: int, progress: Progress, text: str) -> Iterator[T]:
    for done, item in enumerate(items, 1):
        yield item
        progress(text, done / count)


_SUFFIXES = {
    "tiff": (".tif", ".tiff"),
    "csv": (".csv",),
    "netcdf": (".nc",),
    "psf": (".tif", ".tiff"),
    "double-zernike": (".nc",),
    "zernike-table": (".csv",),
}
_WRITERS = {
    "tiff": _write_tiff,
    "csv": _write_csv,
    "netcdf": _write_netcdf,
    "psf": _write_psf,
    "double-zernike": _write_double_zernike,
    "zernike-table": _write_zernike_table,
}
