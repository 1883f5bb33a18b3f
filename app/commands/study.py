"""`svwfs selftest`, `study` and `paper`: accuracy against known truths, and beside the paper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.commands import options, terminal
from app.errors import RunError
from app.files import check_outputs

if TYPE_CHECKING:
    from app.batch.workers import Workers
    from app.bench.config import Bench
    from app.evaluation.studies import Study, StudyResult


def selftest() -> None:
    """Check signs, axes and units with phases known in closed form.

    Example: svwfs selftest
    """
    from rich.console import Console

    from app.evaluation.selftest import run_checks

    console, passed = Console(), []
    console.print("what was put in                       RMS (rad)   scale   residual (rad)")
    for check in run_checks():
        passed.append(check.passes)
        verdict = "[green]ok[/]" if check.passes else "[red]WRONG[/]"
        numbers = f"{check.rms_rad:9.3f}  {check.scale:6.3f}  {check.residual_rad:15.4f}"
        console.print(f"{check.name:36s}  {numbers}   {verdict}", highlight=False)
    if not all(passed):
        raise RunError("the selftest failed: this installation must not be trusted")


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
    bench: options.Bench = "paper_simulation",
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
    from app.evaluation.studies import files_of
    from app.evaluation.study import chosen_studies

    studies = chosen_studies(names or [], frames)
    loaded = options.load(bench, setting)
    inputs = [*options.files_of_bench(bench, loaded), *(Path(name) for name in names or [])]
    check_outputs(files_of(studies, out), inputs=inputs, overwrite=overwrite)
    if workers is None and scheduler is None:
        _run(studies, loaded, seeds, out)
        return
    from app.batch.workers import workers as start

    with start(workers, scheduler, dashboard=dashboard) as evaluate:
        if evaluate.dashboard:
            typer.echo(f"dashboard: {evaluate.dashboard}", err=True)
        _run(studies, loaded, seeds, out, evaluate)


def _run(studies: Sequence[Study], bench: Bench, seeds: int, out: Path, evaluate: Workers | None = None) -> None:
    """Run studies under a progress bar, and print their results."""
    from app.evaluation.studies import run_studies

    with terminal.progress_bar() as progress:
        results = run_studies(bench, studies, seeds, out, progress, evaluate)
    print_results(results)


def print_results(results: Sequence[StudyResult]) -> None:
    """Print a table for each study, the sweeps first."""
    from app.evaluation.studies import Sweep, sweeps_of

    sweeps = sweeps_of(results)
    for sweep, data in sweeps:
        terminal.print_table(*sweep.printed(data))
    if sweeps:
        terminal.print_sentence(Sweep.legend)
    for each in results:
        if not isinstance(each.study, Sweep):
            terminal.print_table(*each.study.printed(each.data))


paper = typer.Typer(
    help="Reproduce the paper's tables beside its own numbers.", no_args_is_help=True, rich_markup_mode=None
)
OutOption = Annotated[Path, options.folder_option("Folder for the table (JSON, CSV) and its figure.")]
PeersOption = Annotated[bool, typer.Option(help="Include the slow methods of SimpleITK (extra: peers).")]


def _reproduce(table: Study, bench: Bench, seeds: int, out: Path, *, overwrite: bool) -> None:
    from app.evaluation.studies import files_of

    check_outputs(files_of([table], out), inputs=bench.files, overwrite=overwrite)
    _run([table], bench, seeds, out)


@paper.command(cls=options.OnceCommand)
def table1(
    *,
    out: OutOption,
    seeds: options.Seeds = 1,
    peers: PeersOption = False,
    overwrite: options.Overwrite = False,
    bench: options.Bench = "paper_simulation",
    setting: options.Set = None,
) -> None:
    """Table 1: every method on the simulated bench, against the truth.

    Example: svwfs paper table1 --out paper
    """
    from app.evaluation import paper as tables

    _reproduce(tables.table1(peers=peers), options.load(bench, setting), seeds, out, overwrite=overwrite)


@paper.command(cls=options.OnceCommand)
def table2(
    *,
    out: OutOption,
    seeds: options.Seeds = 1,
    peers: PeersOption = False,
    overwrite: options.Overwrite = False,
    bench: options.Bench = "paper_experiment",
    setting: options.Set = None,
) -> None:
    """Table 2: every method on noisy frames of the experiment, against the stars.

    Example: svwfs paper table2 --seeds 3 --out paper
    """
    from app.evaluation import paper as tables

    _reproduce(tables.table2(peers=peers), options.load(bench, setting), seeds, out, overwrite=overwrite)


@paper.command(cls=options.OnceCommand)
def sources(
    *,
    out: OutOption,
    seeds: options.Seeds = 1,
    overwrite: options.Overwrite = False,
    bench: options.Bench = "paper_simulation",
    setting: options.Set = None,
) -> None:
    """The supplement's study of other source shapes.

    Example: svwfs paper sources --out paper
    """
    from app.evaluation import paper as tables

    _reproduce(tables.sources(), options.load(bench, setting), seeds, out, overwrite=overwrite)
