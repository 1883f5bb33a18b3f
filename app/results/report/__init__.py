"""Report of a recording as PDF or PNG: conditions, wavefronts and their uncertainty."""

from functools import partial
from pathlib import Path

from matplotlib.backends.backend_pdf import PdfPages

from app.errors import InputError
from app.files import atomic_write, check_outputs
from app.progress import Progress, between, part
from app.recording.folder import parts_of
from app.recording.reader import Recording
from app.results.replay import change_of
from app.results.report import pages
from app.results.report.summary import Residual, Summary, residual_of, summarise

_PNG_DPI = 110
_RECONSTRUCTED = 0.8  # share of the work that comes before the pages


def report_pages(
    folder: Path,
    out: Path,
    *,
    beside: Path | None,
    settings: tuple[str, ...],
    frames: str | None,
    overwrite: bool,
    progress: Progress,
) -> tuple[Summary, Residual | None]:
    """Write the report of a recording as PDF, or as one PNG.

    The mean wavefronts of another recording `beside` are subtracted, if it is given; `frames` FIRST:END and changed
    `settings` are those of the first recording.
    """
    if out.suffix.lower() not in {".pdf", ".png"}:
        raise InputError(f"{out}: a report is a PDF or a PNG: give a name that ends in .pdf or .png")
    folders = [folder, *([] if beside is None else [beside])]
    check_outputs([out], inputs=[part for each in folders for part in parts_of(each)], overwrite=overwrite)
    recordings = [Recording(each) for each in folders]
    parts = [part(between(progress, 0, _RECONSTRUCTED), index, len(recordings)) for index in range(len(recordings))]
    summary = summarise(recordings[0], frames, parts[0], change=change_of(None, settings))
    residual = None if beside is None else residual_of(summary, summarise(recordings[1], None, parts[1]))
    write_pages(out, _pages(summary, residual), between(progress, _RECONSTRUCTED, 1))
    return summary, residual


def write_pages(out: Path, drawn: list[pages.Page], progress: Progress = lambda *_: None) -> None:
    """Write pages as PDF, or one below the other as PNG (atomic)."""
    with atomic_write(out) as temporary:
        if out.suffix.lower() == ".png":
            pages.all_pages(drawn).savefig(temporary, dpi=_PNG_DPI)
            return
        with PdfPages(temporary) as file:
            for index, page in enumerate(drawn):
                progress("drawing the pages", index / len(drawn))
                file.savefig(pages.one_page(page))


def _pages(summary: Summary, residual: Residual | None) -> list[pages.Page]:
    drawn: list[pages.Page] = [partial(pages.draw_overview, summary=summary)]
    if (stats := summary.statistics) is not None:
        drawn.append(partial(pages.draw_certainty, summary=summary, stats=stats))
        if (found := pages.over_field(stats)) is not None:
            drawn.append(partial(pages.draw_over_field, summary=summary, stats=stats, found=found))
    if residual is not None:
        drawn.append(partial(pages.draw_comparison, residual=residual))
    return drawn
