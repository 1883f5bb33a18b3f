"""Recordings in the formats of other programs; the writers are loaded when they write."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from app.progress import Progress

if TYPE_CHECKING:
    from reconstruction.modes.polynomials import ZernikeOrder

Format = Literal["tiff", "csv", "netcdf", "psf", "double-zernike", "zernike-table"]

EXPORT_FORMATS: dict[Format, tuple[str, tuple[str, ...]]] = {  # what is written, and the suffixes of its file
    "tiff": ("Frames as TIFF", (".tif", ".tiff")),
    "csv": ("RMS and coefficients as CSV", (".csv",)),
    "netcdf": ("All results as NetCDF", (".nc",)),
    "psf": ("Point-spread functions as TIFF", (".tif", ".tiff")),
    "double-zernike": ("Double Zernikes as NetCDF, for GalSim", (".nc",)),
    "zernike-table": ("Zernike coefficients of each view as CSV", (".csv",)),
}


def export_recording(
    folder: Path,
    to: Format,
    out: Path,
    frames: str | None = None,
    progress: Progress = lambda *_: None,
    *,
    order: ZernikeOrder = "noll",
) -> int:
    """Write frames, or their results, in a format, results alone as `csv` only; return their number."""
    from app.recording.reader import Recording
    from app.results.export_writers import EXPORT_WRITERS, write_results_csv, write_zernike_table
    from reconstruction.runtime.threads import one_blas_thread

    if to == "csv" and folder.is_file():
        return write_results_csv(folder, out, frames)
    recording = Recording(folder)
    chosen = recording.select(frames)
    with one_blas_thread():
        writer = partial(write_zernike_table, order=order) if to == "zernike-table" else EXPORT_WRITERS[to]
        writer(recording, chosen, out, progress)
    return len(chosen)
