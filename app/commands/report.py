"""`svwfs report`: a recording on three pages, as PDF or PNG."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal
from app.files import require_suffix


def report(
    recording: options.RecordingFolder,
    *,
    out: Annotated[
        Path, typer.Option(help="File to write: .pdf with A4 pages, or .png with all pages in one picture.")
    ],
    beside: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Another recording of the same sample, to be subtracted.")
    ] = None,
    setting: options.Set = None,
    frames: options.Frames = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Summarise a recording on three pages.

    They show conditions, wavefronts, their uncertainty, lost frames and lenslets, and with the modal method the
    strongest Zernike coefficients over the field. At most 200 frames, evenly spread, are reconstructed again; --set
    tries another method on them. --beside adds a page with the difference of the mean wavefronts to another recording,
    view by view, as in the paper's comparison of the square with the stars.

    Example: svwfs report square --out square.pdf

    Example: svwfs report square --beside stars --set registration.method=correlation --out compared.pdf
    """
    options.check_recording(recording)
    sources = [recording, *([] if beside is None else [beside])]
    options.check_files(out, sources=sources, overwrite=overwrite)
    require_suffix(out, ".pdf", ".png")
    from app.results.report_pages import write_report

    settings = tuple(setting or ())
    with terminal.analysing(recording, out) as progress:
        summary, residual = write_report(
            recording, out, frames=frames, settings=settings, beside=beside, progress=progress
        )
    if residual is not None:
        title = f"RMS (rad) of {residual.name} minus {residual.other_name}, means of their frames"
        cells = ((f"{value:.3f}" for value in row) for row in residual.rms_rad)
        terminal.print_by_view(residual.field, title, cells)
        typer.echo(residual.sentence)
    typer.echo(f"the report of {summary.sampled_frames} is in {out}")
    terminal.print_missing_lines(recording)
    if beside is not None:
        terminal.print_missing_lines(beside)
