"""Recordings in the formats of other programs; the writers are loaded when they write."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import typer

from app.progress import Progress, counted
from app.results.analysis import Frames, RecordingAnalysis

Format = Literal["tiff", "csv", "netcdf", "psf", "double-zernike", "zernike-table"]

EXPORT_FORMATS: dict[Format, tuple[str, tuple[str, ...]]] = {  # what is written, and the suffixes of its file
    "tiff": ("Frames as TIFF", (".tif", ".tiff")),
    "csv": ("RMS and coefficients as CSV", (".csv",)),
    "netcdf": ("All results as NetCDF", (".nc",)),
    "psf": ("Point-spread functions as TIFF", (".tif", ".tiff")),
    "double-zernike": ("Double Zernikes as NetCDF, for GalSim", (".nc",)),
    "zernike-table": ("Zernike coefficients of each view as CSV", (".csv",)),
}


@dataclass(frozen=True, kw_only=True)
class Export(RecordingAnalysis):
    """Convert a recording for other programs.

    tiff: one BigTIFF for ImageJ with times and settings. csv: one row per frame for pandas or a spreadsheet. netcdf:
    the results as written by svwfs measure. psf: one point-spread function per view, mean of the frames, sum 1, for
    deconvolution. double-zernike: NetCDF, one array of coefficients per frame. zernike-table: CSV, one row per frame
    and view. See docs/export.md.

    Example: svwfs export run1 --to csv --out run1.csv

    Example: svwfs export run1 --to double-zernike --out run1.nc
    """

    file_help: ClassVar = "File to write."
    picture_dpi: ClassVar = 0

    to: Annotated[
        Format, typer.Option(help="; ".join(f"{to}: {what}" for to, (what, _) in EXPORT_FORMATS.items()) + ".")
    ]
    frames: Frames = None

    @property
    def suffixes(self) -> tuple[str, ...]:  # type: ignore[override] # those of the format
        """Suffixes of the format."""
        return EXPORT_FORMATS[self.to][1]

    def run(self, source: Path, out: Path, progress: Progress) -> str:
        """Write the frames of a recording, or their results, one after the other."""
        from app.recording.reader import Recording
        from app.results.export_writers import EXPORT_WRITERS
        from reconstruction.runtime.threads import one_blas_thread

        recording = Recording(source)
        chosen = recording.select(self.frames)
        with one_blas_thread():
            EXPORT_WRITERS[self.to](recording, chosen, out, progress)
        return f"{out} holds {counted(len(chosen))} of {source}"

    def sentences(self, found: str) -> list[str]:
        """Say what was written."""
        return [found]
