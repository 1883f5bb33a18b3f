"""Analyses of measured wavefronts: what the file of each has, and all of them by name.

This file loads nothing else, so that the help of the program is fast.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias

import typer

if TYPE_CHECKING:
    from collections.abc import Iterable

    import xarray as xr
    from matplotlib.figure import Figure

    from app.bench.config import Bench
    from app.progress import Progress
    from reconstruction.geometry import Field

# where each is, and the first sentence of its help
ANALYSES = {
    "export": ("app.results.export.Export", "Convert a recording for other programs."),
    "report": ("app.results.report.Report", "Summarise a recording on three pages."),
    "layers": ("app.results.layers.Layers", "Find at which distance the aberration originates."),
    "corrector": ("app.results.corrector.BestCorrector", "Tell what one corrector could do, over its distance."),
    "field": ("app.results.coefficients.FieldMaps", "Map the coefficients of a wavefront over the field, with errors."),
    "deconvolve": (
        "app.results.deconvolution.Deconvolution",
        "Deconvolve an image by the measured aberration of each field position.",
    ),
}

# options of several commands
RecordingFolder = Annotated[Path, typer.Argument(metavar="recording", help="Folder of a recording.")]
RunOrResult = Annotated[Path, typer.Argument(metavar="RUN|RESULT", help="Folder of a recording, or a results file.")]
Frame = Annotated[int, typer.Option(min=0, help="Frame of the recording or results, counted from 0.")]
Frames = Annotated[
    str | None,
    typer.Option(metavar="FIRST:END", help="Only these frames, counted from 0; END is excluded; -10: is the last 10."),
]
Origin = Literal["lenslets", "mask"]
From = Annotated[
    Origin, typer.Option("--from", help="Where distances are measured from: lenslets, in the collimated beam, or mask.")
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting of the bench, as registration.warp=affine."),
]
ByView: TypeAlias = "tuple[Field, str, Iterable[Iterable[str]]]"  # a cell for each view of a field, under a title


class Analysis:
    """An analysis: a frozen dataclass with its options as fields and the help as docstring.

    An impossible combination of options is an `InputError`. Window and Python use the same functions of its file. What
    is found is a dataset with names and units, unless the analysis has a `run` of its own.
    """

    source: ClassVar[object] = RunOrResult  # the option of its wavefronts
    file_help: ClassVar[str]  # of the file that it writes
    suffixes: ClassVar[tuple[str, ...]] = (".nc",)  # of that file
    needs_suffix: ClassVar[bool] = False  # which says what is written
    picture_dpi: ClassVar[int] = 150  # 0: it has no picture
    closing: ClassVar[str] = ""  # after the sentences on the terminal, of the file `out`
    frame: int | None = None  # its only frame
    setting: list[str] | None = None  # changes of the bench

    def run(self, source: Path, out: Path, progress: Progress) -> Any:
        """Compute the results and write them; return what was found."""
        from app.progress import between

        bench, found = self.compute(source, between(progress, 0.0, 0.9))
        progress("writing", 0.9)
        self.write(found, bench, source, out)
        return found

    def compute(self, source: Path, progress: Progress) -> tuple[Bench, xr.Dataset]:
        """Return bench and results of a recording or a file of results."""
        raise NotImplementedError

    def sentences(self, found: Any) -> list[str]:
        """Say what was found."""
        raise NotImplementedError

    def by_view(self, found: Any) -> ByView | None:  # noqa: ARG002 - for analyses that have them
        """Return a table for the terminal; None if there is none."""
        return None

    def draw(self, found: xr.Dataset) -> Figure:
        """Draw the results."""
        raise NotImplementedError

    def write(self, found: xr.Dataset, bench: Bench, source: Path, out: Path) -> None:
        """Write the results."""
        from app.results.result_file import write_results

        of_frame = {} if self.frame is None else {"frame": str(self.frame)}
        write_results(out, found, bench=bench, inputs={"source": source.name, **of_frame})

    def more_files(self, source: Path) -> tuple[Iterable[Path], Iterable[Path]]:  # noqa: ARG002 - for analyses that have them
        """Return more files that it reads and writes; `InputError` if one of them cannot be used."""
        return (), ()

    def sources(self, source: Path) -> dict[Path, Iterable[str]]:
        """Return recordings and results that it works on, each with the changed settings of its bench."""
        return {source: self.setting or ()}


class RecordingAnalysis(Analysis):
    """An analysis of recordings alone."""

    source: ClassVar[object] = RecordingFolder

    def more_files(self, source: Path) -> tuple[Iterable[Path], Iterable[Path]]:
        """Refuse a folder without a recording, before anything is loaded that takes seconds."""
        from app.recording.folder import read_run

        read_run(source)
        return (), ()


def load_analysis(name: str) -> type[Analysis]:
    """Read the file of an analysis."""
    module, _, kind = ANALYSES[name][0].rpartition(".")
    found: type[Analysis] = getattr(import_module(module), kind)
    return found
