"""`svwfs export`: a recording in the formats of other programs."""

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal
from app.progress import counted
from app.results.export_formats import FORMATS, Format


def export(
    recording: options.Recording,
    *,
    to: Annotated[Format, typer.Option(help="; ".join(f"{to}: {what}" for to, (what, _) in FORMATS.items()) + ".")],
    out: Annotated[Path, typer.Option(help="File to write.")],
    frames: options.Frames = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Convert a recording for other programs.

    tiff: one BigTIFF for ImageJ with times and settings. csv: one row per frame for pandas or a spreadsheet. netcdf:
    the results as written by svwfs measure. psf: one point-spread function per view, mean of the frames, sum 1, for
    deconvolution. double-zernike: NetCDF, one array of coefficients per frame. zernike-table: CSV, one row per frame
    and view. See docs/export.md.

    Example: svwfs export run1 --to csv --out run1.csv

    Example: svwfs export run1 --to double-zernike --out run1.nc
    """
    from app.results.export import export as run

    with terminal.progress_bar() as progress:
        count = run(recording, to, out, frames=frames, overwrite=overwrite, progress=progress)
    typer.echo(f"{out} holds {counted(count)} of {recording}")
    terminal.print_notes(recording, is_own=to != "tiff")  # of which nothing is reconstructed
