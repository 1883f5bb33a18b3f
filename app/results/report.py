"""Report of a recording as PDF or PNG; what it shows and draws is loaded when it is written."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import typer

from app.progress import Progress, between, part
from app.results.analysis import ByView, Frames, RecordingAnalysis, Set

if TYPE_CHECKING:
    from app.results.report_summary import Residual, Summary

_RECONSTRUCTED = 0.8  # share of the work that comes before the pages


@dataclass(frozen=True, kw_only=True)
class Report(RecordingAnalysis):
    """Summarise a recording on three pages.

    They show conditions, wavefronts, their uncertainty, lost frames and lenslets, and with the modal method the
    strongest Zernike coefficients over the field. At most 200 frames, evenly spread, are reconstructed again; --set
    tries another method on them. --beside adds a page with the difference of the mean wavefronts to another recording,
    view by view, as in the paper's comparison of the square with the stars.

    Example: svwfs report square --out square.pdf

    Example: svwfs report square --beside stars --set registration.method=correlation --out compared.pdf
    """

    file_help: ClassVar = "File to write: .pdf with A4 pages, or .png with all pages in one picture."
    suffixes: ClassVar = (".pdf", ".png")
    needs_suffix: ClassVar = True
    picture_dpi: ClassVar = 0

    beside: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Another recording of the same sample, to be subtracted.")
    ] = None
    setting: Set = None
    frames: Frames = None

    def run(self, source: Path, out: Path, progress: Progress) -> tuple[str, Summary, Residual | None]:
        """Write the pages as PDF, or as one PNG; `frames` and `setting` are those of the first recording."""
        from app.recording.reader import Recording
        from app.results.replay import change_of
        from app.results.report_pages import write_pages
        from app.results.report_summary import residual_of, summarise

        recordings = [Recording(each) for each in filter(None, (source, self.beside))]
        parts = [part(between(progress, 0, _RECONSTRUCTED), index, len(recordings)) for index in range(len(recordings))]
        summary = summarise(recordings[0], self.frames, parts[0], change=change_of(None, tuple(self.setting or ())))
        residual = None if self.beside is None else residual_of(summary, summarise(recordings[1], None, parts[1]))
        write_pages(out, summary, residual, between(progress, _RECONSTRUCTED, 1))
        return f"the report of {summary.sampled_frames} is in {out}", summary, residual

    def sentences(self, found: tuple[str, Summary, Residual | None]) -> list[str]:
        """Say what differs, and of how many frames the report is."""
        written, _, residual = found
        return [*([] if residual is None else [residual.sentence]), written]

    def by_view(self, found: tuple[str, Summary, Residual | None]) -> ByView | None:
        """Return the differences to the other recording."""
        if (residual := found[-1]) is None:
            return None
        title = f"RMS (rad) of {residual.name} minus {residual.other_name}, means of their frames"
        return residual.field, title, ((f"{value:.3f}" for value in row) for row in residual.rms_rad)

    def sources(self, source: Path) -> dict[Path, Iterable[str]]:
        """Return the changed settings of the first recording, and the other one."""
        others = {} if self.beside is None else {self.beside: ()}
        return RecordingAnalysis.sources(self, source) | others
