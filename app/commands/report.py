"""`svwfs report`: a recording summarised on three pages."""

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal


def report(
    recording: options.Recording,
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
    strongest Zernike coefficients over the field. At most 200 frames, evenly
    spread, are reconstructed again; --set tries another method on them. --beside adds a page with the difference of the
    mean wavefronts to another recording, view by view, as in the paper's comparison of the square with the stars.

    Example: svwfs report square --out square.pdf

    Example: svwfs report square --beside stars --set registration.method=correlation --out compared.pdf
    """
    options.check_recordings(recording)
    from app.results.report import report_pages

    settings, sources = tuple(setting or ()), filter(None, (recording, beside))
    options.check_files(out, reads=options.files_of_sources(*sources), overwrite=overwrite)
    with terminal.progress_bar() as progress:
        summary, residual = report_pages(
            recording, out, beside=beside, settings=settings, frames=frames, progress=progress
        )
    if residual is not None:
        title = f"RMS (rad) of {residual.name} minus {residual.other_name}, means of their frames"
        terminal.print_by_view(residual.field, title, ((f"{value:.3f}" for value in row) for row in residual.rms_rad))
        terminal.print_sentence(residual.sentence)
    typer.echo(f"the report of {summary.sampled_frames} is in {out}")
    terminal.print_notes(recording, setting)
    if beside is not None:
        terminal.print_notes(beside)
