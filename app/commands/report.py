"""`svwfs report`: a recording on three pages, or results on two, as PDF or PNG."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal
from app.errors import InputError
from app.files import require_suffix


def report(
    source: options.RunOrResult,
    *,
    out: Annotated[Path, typer.Option(help="File to write: .pdf with A4 pages, or .png with all pages in one.")],
    setting: options.Set = None,
    frames: options.Frames = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Summarise a recording on three pages, or a results file on two.

    They show conditions, wavefronts, their uncertainty, lost frames and lenslets, and with the modal method the
    strongest Zernike coefficients over the field. At most 200 frames, evenly spread, are reconstructed again; --set
    tries another method on them. Of a results file, which has no frames, the report has two pages: the mean wavefront
    and the coefficients. `svwfs compare` subtracts another recording.

    Example: svwfs report square --out square.pdf

    Example: svwfs report result.nc --out result.png
    """
    if not source.is_file():
        options.check_recordings(source)
    elif setting or frames:
        raise InputError(f"{source}: has no frames to reconstruct again: leave --set and --frames out")
    options.check_files(out, sources=[source], overwrite=overwrite)
    require_suffix(out, ".pdf", ".png")
    from app.results.report_pages import write_report, write_result_report

    with terminal.analysing(source, out) as progress:
        if source.is_file():
            write_result_report(source, out)
            what = str(source)
        else:
            settings = tuple(setting or ())
            what = write_report(source, out, frames=frames, settings=settings, progress=progress).sampled_frames
    terminal.print_sentence(f"the report of {what} is in {out}")
    terminal.print_missing_lines(source)
