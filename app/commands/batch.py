"""`svwfs batch`: many recordings reconstructed in parallel into one store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.commands import options, terminal
from app.errors import RunError
from app.progress import counted

if TYPE_CHECKING:
    from app.batch.run import Batch


def batch(
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Folders of recordings.")],
    *,
    out: Annotated[Path, options.folder_option("Zarr store for the results; one that exists is continued.")],
    bench: Annotated[str | None, options.bench_option("Another bench than the recorded ones.")] = None,
    setting: options.Set = None,
    frames: options.Frames = None,
    refine: Annotated[
        int, typer.Option(min=0, max=options.MOST_ROUNDS, help="Rounds of refinement of each frame, at most.")
    ] = 0,
    workers: options.Workers = None,
    scheduler: options.Scheduler = None,
) -> None:
    """Reconstruct many recordings in parallel into one Zarr store.

    The wavefronts are those of svwfs replay --out, whatever the number of workers; by default there is one for each
    core. The same command again does only what is missing: after Ctrl-C, a power failure, or with more
    recordings. A recording or a frame that cannot be used is named at the end. xarray.open_zarr opens the store, see
    `svwfs docs sharing`, also for clusters.

    Example: svwfs batch run1 run2 run3 --out results.zarr

    Example: svwfs batch run1 --refine 3 --scheduler tcp://node1:8786 --out refined.zarr
    """
    options.check_recordings(*recordings)
    from app.batch.run import check_batch, run_batch
    from app.batch.store import BatchJob
    from app.batch.workers import workers as start
    from app.bench.config import load_bench, write_bench

    settings = tuple(setting or ())
    other = "" if bench is None else write_bench(load_bench(bench, settings))
    job = BatchJob(bench=other, settings=() if other else settings, rounds=refine, frames=frames or "")
    check_batch(recordings, out, job)
    with start(workers, scheduler) as evaluate, terminal.progress_bar() as progress:
        done = run_batch(recordings, out, job, evaluate, progress)
    print_batch(done, out)
    if done.failed:
        raise RunError(f"{len(done.failed)} of {done.recordings} recordings failed")
    if lost := sum(map(len, done.damaged.values())):
        raise RunError(f"{counted(lost)} damaged and left out")


def print_batch(batch: Batch, out: Path) -> None:
    """Print why recordings and frames failed, and the number of frames in the store."""
    for reason in batch.failed.values():
        terminal.print_warning(reason)
    for copy, original in batch.copies.items():
        terminal.print_warning(f"{copy}: is a copy of {original}, whose results are in the store under one name")
    for folder, reasons in batch.damaged.items():
        terminal.print_warning(f"{folder}: {counted(len(reasons))} damaged and left out: {reasons[0]}")
    without = batch.frames - batch.wavefronts
    why = f" ({batch.problem})" if batch.problem else ""
    missing = f"; {without} of them without a wavefront{why}" if without else ""
    done = batch.recordings - len(batch.failed)
    before = f", {batch.frames - batch.computed} of them from before" if batch.frames > batch.computed else ""
    terminal.print_sentence(f"{out} holds {counted(done, 'recording')} with {counted(batch.frames)}{before}{missing}")
