"""Recordings in the formats of other programs; the writers are loaded when they write."""

from pathlib import Path
from typing import Literal

from app.progress import Progress

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
    folder: Path, to: Format, out: Path, frames: str | None = None, progress: Progress = lambda *_: None
) -> int:
    """Write frames of a recording, or their results, one after the other; return their number."""
    from app.recording.reader import Recording
    from app.results.export_writers import EXPORT_WRITERS
    from reconstruction.runtime.threads import one_blas_thread

    recording = Recording(folder)
    chosen = recording.select(frames)
    with one_blas_thread():
        EXPORT_WRITERS[to](recording, chosen, out, progress)
    return len(chosen)
