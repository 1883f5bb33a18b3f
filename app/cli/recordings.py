"""What becomes of a recording: `svwfs recover`, `replay`, `export` and `report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from app.cli.options import FramesOption, SetOption

RecordingArgument = Annotated[Path, typer.Argument(help="The folder of a recording.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the file if it is there.")]


def recover(
    recording: RecordingArgument,
) -> None:
    """Finish a recording whose program was killed, or whose computer lost its power, before it could.

    It tells what is damaged, of a complete recording, too, and which frames are whole. Nothing that can be read is
    changed or lost: lines that are damaged are put aside, into frames.damaged.jsonl.
    """
    from app.cli.tables import print_recovered, progress_bar
    from app.recording.recover import recover as run

    with progress_bar() as progress:
        found = run(recording, lambda fraction: progress("looking at the frames", fraction))
    print_recovered(found, recording)


def replay(
    recording: RecordingArgument,
    *,
    verify: Annotated[
        bool, typer.Option("--verify", help="Fail unless every frame is made again to the last bit.")
    ] = False,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help="Another bench, to compare with the recorded one."),
    ] = None,
    setting: SetOption = None,
    frames: FramesOption = None,
    out: Annotated[Path | None, typer.Option(help="NetCDF file to write the results to.")] = None,
) -> None:
    """Reconstruct the frames of a recording once more, by the dark, reference, lattice and refinement that they had.

    The same software makes the same of them, to the last bit, and says so. With --bench, or --set for a change of the
    recorded bench, both are made and compared view by view: svwfs replay RECORDING --set reconstruction.method=zonal
    """
    from app.cli.tables import print_replay, progress_bar
    from app.results.replay.run import replay as run

    with progress_bar() as progress:
        made = run(
            recording,
            bench=bench,
            settings=tuple(setting or ()),
            frames=frames,
            out=out,
            verify=verify,
            progress=progress,
        )
    print_replay(made)


def export(
    recording: RecordingArgument,
    *,
    to: Annotated[
        Literal["tiff", "csv", "netcdf", "psf"],
        typer.Option(
            help="tiff: the frames; csv: RMS and coefficients; netcdf: all results; psf: what a point becomes."
        ),
    ],
    out: Annotated[Path, typer.Option(help="The file to write.")],
    frames: FramesOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a recording as other programs read it; docs/export.md says what is in the files.

    tiff is one BigTIFF for ImageJ, with times and settings; csv one row a frame, for pandas or a spreadsheet; netcdf
    what svwfs measure writes; psf one point-spread function a view, the mean of the frames, its sum 1, to sharpen with.
    """
    from app.cli.tables import progress_bar
    from app.results.export.run import export as run

    with progress_bar() as progress:
        count = run(recording, to, out, frames=frames, overwrite=overwrite, progress=progress)
    typer.echo(f"{count} frames of {recording} are in {out}")


def report(
    recording: RecordingArgument,
    *,
    out: Annotated[Path, typer.Option(help="The file to write: .pdf, pages of A4, or .png, all in one picture.")],
    beside: Annotated[
        Path | None,
        typer.Option(metavar="RECORDING", help="Another recording of the same sample, to subtract its wavefronts."),
    ] = None,
    setting: SetOption = None,
    frames: FramesOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Put a recording on two pages: when, with what, which wavefronts, how sure they are, and what was lost.

    Frames are reconstructed again, at most 200, spread evenly. With --beside a third page subtracts the mean wavefronts
    of another recording view by view, and a table says what is left, as the paper compares a square with stars;
    --set tries another method on the first: svwfs report SQUARE --beside STARS --set registration.method=correlation
    """
    from app.cli.tables import print_residual, progress_bar
    from app.results.report.run import report_pages

    with progress_bar() as progress:
        summary, residual = report_pages(
            recording,
            out,
            beside=beside,
            settings=tuple(setting or ()),
            frames=frames,
            overwrite=overwrite,
            progress=progress,
        )
    if residual is not None:
        print_residual(residual)
    typer.echo(f"the report of {summary.frames_looked_at} is in {out}")
