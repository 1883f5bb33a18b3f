"""Commands on recordings: `svwfs recover`, `replay`, `batch`, `export` and `report`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from app.cli.command import FOLDER
from app.cli.options import DashboardOption, FramesOption, OverwriteOption, SchedulerOption, SetOption, WorkersOption
from app.errors import RunError
from app.progress import counted

RecordingArgument = Annotated[Path, typer.Argument(help="Folder of a recording.")]


def recover(recording: RecordingArgument) -> None:
    """Complete a recording cut short by a crash or power failure.

    Any damage is reported. Readable frames are never changed or lost; damaged lines are moved to frames.damaged.jsonl.

    Example: svwfs recover run1
    """
    from app.cli.tables import print_recovered, progress_bar
    from app.recording.recover import recover as run

    with progress_bar() as progress:
        recovered = run(recording, lambda fraction: progress("checking the frames", fraction))
    print_recovered(recovered, recording)
    if not recovered.whole:
        raise RunError(f"{recording}: no frame is whole")
    if not recovered.has_calibration:
        raise RunError(f"{recording}: no frame can be reconstructed, because no calibration can be read")


def replay(
    recording: RecordingArgument,
    *,
    verify: Annotated[bool, typer.Option("--verify", help="Fail unless every frame is reproduced bit by bit.")] = False,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help="Another bench to compare with the recorded one."),
    ] = None,
    setting: SetOption = None,
    frames: FramesOption = None,
    out: Annotated[Path | None, typer.Option(help="NetCDF file for the results.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Reconstruct the frames of a recording again.

    They keep their own dark, reference, lattice and refinement: the same software reproduces the results bit by bit.
    With another --bench, or the recorded one changed by --set, the wavefronts are compared with the recorded ones view
    by view.

    Example: svwfs replay run1 --verify

    Example: svwfs replay run1 --set reconstruction.method=zonal
    """
    from app.cli.tables import print_replay, print_version_notice, progress_bar
    from app.results.replay import replay as run

    with progress_bar() as progress:
        made = run(
            recording,
            bench=bench,
            settings=tuple(setting or ()),
            frames=frames,
            out=out,
            overwrite=overwrite,
            verify=verify,
            progress=progress,
        )
    print_replay(made)
    if bench is None:
        print_version_notice(recording, settings=tuple(setting or ()))
    _warn_of_missing(recording)


def batch(
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Folders of recordings.")],
    *,
    out: Annotated[
        Path, typer.Option(metavar=FOLDER, help="Zarr store for the results; one that exists is continued.")
    ],
    bench: Annotated[
        str | None, typer.Option("--bench", "-b", metavar="TOML", help="Another bench than the recorded ones.")
    ] = None,
    setting: SetOption = None,
    frames: FramesOption = None,
    refine: Annotated[
        int, typer.Option(min=0, max=100, help="Maximum rounds of refinement of each frame, instead of the recorded.")
    ] = 0,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    dashboard: DashboardOption = False,
) -> None:
    """Reconstruct many recordings in parallel into one Zarr store.

    The wavefronts are those of svwfs replay --out, bit by bit, whatever the number of workers; by default there is one
    for each core. The same command again does only what is missing: after Ctrl-C, a power failure, or with more
    recordings. A recording or a frame that cannot be used is named at the end. xarray.open_zarr opens the store, see
    docs/many_machines.md, also for clusters.

    Example: svwfs batch run1 run2 run3 --out results.zarr

    Example: svwfs batch run1 --refine 3 --scheduler tcp://node1:8786 --out refined.zarr
    """
    from app.batch.job import Job
    from app.batch.run import check_store, run_batch
    from app.batch.workers import workers as start
    from app.bench.config import load_bench, write_bench
    from app.cli.tables import print_batch, print_version_notice, progress_bar

    settings = tuple(setting or ())
    other = "" if bench is None else write_bench(load_bench(bench, settings))
    job = Job(bench=other, settings=() if other else settings, rounds=refine, frames=frames or "")
    check_store(recordings, out, job)
    with start(workers, scheduler, dashboard=dashboard) as evaluate, progress_bar() as progress:
        if evaluate.dashboard:
            typer.echo(f"dashboard: {evaluate.dashboard}", err=True)
        done = run_batch(recordings, out, job, evaluate, progress)
    print_batch(done, out)
    if bench is None:
        print_version_notice(*recordings, settings=settings)
    if done.failed:
        raise RunError(f"{len(done.failed)} of {done.recordings} recordings failed")


def export(
    recording: RecordingArgument,
    *,
    to: Annotated[
        Literal["tiff", "csv", "netcdf", "psf", "double-zernike", "zernike-table"],
        typer.Option(
            help="tiff: frames; csv: RMS and coefficients; netcdf: all results; psf: point-spread functions;"
            " double-zernike: for GalSim; zernike-table: Zernike coefficients of each view."
        ),
    ],
    out: Annotated[Path, typer.Option(help="File to write.")],
    frames: FramesOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Convert a recording for other programs.

    tiff: one BigTIFF for ImageJ with times and settings. csv: one row per frame for pandas or a spreadsheet. netcdf:
    the results as written by svwfs measure. psf: one point-spread function per view, mean of the frames, sum 1, for
    deconvolution. double-zernike: NetCDF, one array of coefficients per frame. zernike-table: CSV, one row per frame
    and view. See docs/export.md.

    Example: svwfs export run1 --to csv --out run1.csv

    Example: svwfs export run1 --to double-zernike --out run1.nc
    """
    from app.cli.tables import print_version_notice, progress_bar
    from app.results.export import export as run

    with progress_bar() as progress:
        count = run(recording, to, out, frames=frames, overwrite=overwrite, progress=progress)
    typer.echo(f"{out} holds {counted(count)} of {recording}")
    if to != "tiff":  # nothing is reconstructed
        print_version_notice(recording)
    _warn_of_missing(recording)


def report(
    recording: RecordingArgument,
    *,
    out: Annotated[
        Path, typer.Option(help="File to write: .pdf with A4 pages, or .png with all pages in one picture.")
    ],
    beside: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Another recording of the same sample, to be subtracted.")
    ] = None,
    setting: SetOption = None,
    frames: FramesOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Summarise a recording on three pages.

    They show conditions, wavefronts, their uncertainty, lost frames and lenslets, and with the modal method the
    strongest Zernike coefficients over the field. At most 200 frames, evenly
    spread, are reconstructed again; --set tries another method on them. --beside adds a page with the difference of the
    mean wavefronts to another recording, view by view, as in the paper's comparison of the square with the stars.

    Example: svwfs report square --out square.pdf

    Example: svwfs report square --beside stars --set registration.method=correlation --out compared.pdf
    """
    from app.cli.tables import print_residual, print_version_notice, progress_bar
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
    typer.echo(f"the report of {summary.sampled_frames} is in {out}")
    print_version_notice(recording, settings=tuple(setting or ()))
    _warn_of_missing(recording)
    if beside is not None:
        print_version_notice(beside)
        _warn_of_missing(beside)


def _warn_of_missing(folder: Path) -> None:
    """Warn if a complete recording has fewer lines than frames."""
    from app.cli.tables import print_warning
    from app.recording.reader import Recording

    recording = Recording(folder)
    missing = (recording.recorded_frames or 0) - len(recording)
    if recording.is_complete and missing > 0:
        print_warning(
            f"{folder}: {missing} of {recording.recorded_frames} frames have no line; svwfs recover lists them"
        )
