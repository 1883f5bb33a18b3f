"""`svwfs export`: a recording or results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal
from app.errors import InputError
from app.progress import counted
from app.results.export import EXPORT_FORMATS, Format, export_recording


def export(
    source: options.RunOrResult,
    *,
    to: Annotated[
        Format, typer.Option(help="; ".join(f"{to}: {what}" for to, (what, _) in EXPORT_FORMATS.items()) + ".")
    ],
    out: Annotated[Path, typer.Option(help="File to write.")],
    frames: options.Frames = None,
    order: options.Order = "noll",
    overwrite: options.Overwrite = False,
) -> None:
    """Convert a recording, or a results file into csv, for other programs.

    tiff: one BigTIFF for ImageJ with times and settings. csv: one row per frame for pandas or a spreadsheet. netcdf:
    the results as written by svwfs measure. psf: one point-spread function per view, mean of the frames, sum 1, for
    deconvolution. double-zernike: NetCDF, one array of coefficients per frame. zernike-table: CSV, one row per frame
    and view, in the --order of Noll, OSA/ANSI or fringe. See `svwfs docs recording`.

    Example: svwfs export run1 --to csv --out run1.csv

    Example: svwfs export run1 --to double-zernike --out run1.nc
    """
    if source.is_file() and to != "csv":
        raise InputError(f"{source}: of a results file only --to csv can be written: give the recording")
    if not source.is_file():
        options.check_recordings(source)
    options.check_files(out, sources=[source], suffixes=EXPORT_FORMATS[to][1], overwrite=overwrite)
    with terminal.analysing(source, out) as progress:
        count = export_recording(source, to, out, frames, progress, order=order)
    typer.echo(f"{out} holds {counted(count)} of {source}")
    terminal.print_missing_lines(source)
