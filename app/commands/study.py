"""`svwfs study`: accuracy against known truths."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.bench.presets import PAPER
from app.commands import options, terminal

if TYPE_CHECKING:
    from app.batch.workers import Workers
    from app.bench.config import Bench
    from app.evaluation.studies import Study, StudyResult


def study(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...",
            help="Names of sweeps, or calibration, exposure, deconvolution, corrector, distances or bench; all sweeps "
            "if omitted. mask or masks, then masks: image files or names such as circle or checkerboard:5; after masks "
            "also folders of pictures.",
        ),
    ] = None,
    *,
    out: Annotated[Path, options.folder_option("Folder for tables and figures: JSON, CSV and PNG.")],
    seeds: options.Seeds = 3,
    frames: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="With calibration: add the *_reference.tif in DIR, taken with its bench.toml."
        ),
    ] = None,
    bench: options.Bench = PAPER,
    workers: options.Workers = None,
    scheduler: options.Scheduler = None,
    dashboard: options.Dashboard = False,
    overwrite: options.Overwrite = False,
    setting: options.Set = None,
) -> None:
    """Measure the estimator's error against the truth.

    The sweeps vary noise, defects and sources (docs/estimator.md). More studies have names: calibration tests how well
    lattices are found, exposure how fast auto-exposure is (docs/calibration.md), deconvolution how good corrected
    images are (docs/corrected_images.md), corrector what correctors leave in frames through them and distances how well
    layers are found (docs/layers.md). bench tells what imperfections of a bench cost, and mask predicts how accurate a
    mask will be before it is manufactured, beside the square (docs/estimator.md); masks compares many, by prediction
    alone (docs/masks.md).
    --workers or --scheduler share the seeds among processes (docs/many_machines.md).

    Example: svwfs study photons --seeds 100 --workers 8 --out study

    Example: svwfs study mask ring.png circle --seeds 1 --out study

    Example: svwfs study masks optimised pictures --seeds 1 --out study
    """
    from app.batch.workers import workers as start
    from app.evaluation.studies import files_of
    from app.evaluation.study import chosen_studies

    studies = chosen_studies(names or [], frames)
    loaded = options.load(bench, setting)
    inputs = [*options.files_of_bench(bench, loaded), *(Path(name) for name in names or [])]
    options.check_files(*files_of(studies, out), reads=inputs, overwrite=overwrite)
    shared = (
        nullcontext() if workers is None and scheduler is None else start(workers, scheduler, has_dashboard=dashboard)
    )
    with shared as evaluate:
        if evaluate is not None and evaluate.dashboard:
            typer.echo(f"dashboard: {evaluate.dashboard}", err=True)
        run_and_print(studies, loaded, seeds=seeds, out=out, evaluate=evaluate)


def run_and_print(
    studies: Sequence[Study], bench: Bench, *, seeds: int, out: Path, evaluate: Workers | None = None
) -> None:
    """Run studies under a progress bar, and print their results."""
    from app.evaluation.studies import run_studies

    with terminal.progress_bar() as progress:
        results = run_studies(studies, bench, seeds=seeds, out=out, progress=progress, evaluate=evaluate)
    print_results(results)


def print_results(results: Sequence[StudyResult]) -> None:
    """Print a table for each study, the sweeps first."""
    from app.evaluation.study_kinds import Sweep, sweeps_of

    sweeps = sweeps_of(results)
    for sweep, data in sweeps:
        terminal.print_table(*sweep.printed(data))
    if sweeps:
        terminal.print_sentence(Sweep.legend)
    for each in results:
        if not isinstance(each.study, Sweep):
            terminal.print_table(*each.study.printed(each.data))
