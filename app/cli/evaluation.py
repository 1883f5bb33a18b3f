"""Commands that evaluate accuracy and speed: `svwfs selftest`, `study`, `benchmark` and `paper`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.command import FOLDER, Command
from app.cli.options import (
    BenchOption,
    DashboardOption,
    OverwriteOption,
    SchedulerOption,
    SeedsOption,
    SetOption,
    WorkersOption,
    bench_file,
    load,
)
from app.errors import InputError, RunError
from app.files import check_outputs, check_suffix

if TYPE_CHECKING:
    from app.bench.config import Bench
    from app.evaluation.study_kinds import Study
    from app.tasks import Evaluate

_LIVE_BENCH = "live_demo"
_LIVE_EXPOSURE_S = 0.014286  # 70 frames/s


def selftest() -> None:
    """Check signs, axes and units with phases known in closed form.

    Example: svwfs selftest
    """
    from app.cli.tables import print_checks
    from app.evaluation.selftest import run_checks

    if not print_checks(run_checks()):
        raise RunError("the selftest failed: this installation must not be trusted")


def study(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...",
            help="Names of sweeps, or calibration, exposure, deconvolution, corrector or distances; all sweeps if "
            "omitted. mask, then the masks to predict: image files or names such as circle.",
        ),
    ] = None,
    *,
    out: Annotated[Path, typer.Option(metavar=FOLDER, help="Folder for tables and figures: JSON, CSV and PNG.")],
    seeds: SeedsOption = 3,
    frames: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="With calibration: add the *_reference.tif in DIR, taken with its bench.toml."
        ),
    ] = None,
    bench: BenchOption = "paper_simulation",
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    dashboard: DashboardOption = False,
    overwrite: OverwriteOption = False,
    setting: SetOption = None,
) -> None:
    """Measure the estimator's error against the truth.

    The sweeps vary noise, defects and sources (docs/estimator.md). More studies have names: calibration tests how well
    lattices are found, exposure how fast auto-exposure is (docs/calibration.md), deconvolution how good corrected
    images are (docs/corrected_images.md), corrector what correctors leave in frames through them and distances how well
    layers are found (docs/layers.md), and mask predicts how accurate a mask will be before it is manufactured, beside
    the square (docs/estimator.md).
    --workers or --scheduler share the seeds among processes (docs/many_machines.md).

    Example: svwfs study photons --seeds 100 --workers 8 --out study

    Example: svwfs study mask ring.png circle --seeds 1 --out study
    """
    from app.evaluation.study.catalogue import chosen_studies

    studies = chosen_studies(names or [], frames)
    inputs = [bench_file(bench), *(Path(name) for name in names or [])]
    loaded = load(bench, setting)
    if workers is None and scheduler is None:
        _run(studies, loaded, seeds, out, inputs=inputs, overwrite=overwrite)
        return
    from app.batch.workers import workers as start

    with start(workers, scheduler, dashboard=dashboard) as evaluate:
        if evaluate.dashboard:
            typer.echo(f"dashboard: {evaluate.dashboard}", err=True)
        _run(studies, loaded, seeds, out, inputs=inputs, overwrite=overwrite, evaluate=evaluate)


def _run(
    studies: Sequence[Study],
    bench: Bench,
    seeds: int,
    out: Path,
    *,
    inputs: Iterable[Path] = (),
    overwrite: bool,
    evaluate: Evaluate | None = None,
) -> None:
    """Run studies under a progress bar and print their results."""
    from app.cli.tables import progress_bar
    from app.evaluation.run_studies import run_studies
    from app.evaluation.study_files import files_of
    from app.evaluation.study_tables import print_results

    check_outputs(files_of(studies, out), inputs=[*inputs, *bench.files], overwrite=overwrite)
    with progress_bar() as progress:
        results = run_studies(bench, studies, seeds, out, progress, evaluate)
    print_results(results)


def benchmark(
    *,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="JSON file for all numbers.")] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Fail if a ratio is 20 % worse than the baseline; with --live, if a limit is missed."
        ),
    ] = False,
    live: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Measure the live path instead for SECONDS, with window and recording; typically 60.",
        ),
    ] = None,
    record_in: Annotated[
        Path | None, typer.Option(metavar=FOLDER, help="With --live: folder of the temporary recording.")
    ] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="With --live: do not record.")] = False,
    panels: Annotated[
        bool, typer.Option("--panels", help="With --live: open coefficients, history and histogram, too.")
    ] = False,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help=f"With --live: simulated bench [default: {_LIVE_BENCH}]."),
    ] = None,
    overwrite: OverwriteOption = False,
    setting: SetOption = None,
) -> None:
    """Measure the speed beside other libraries.

    It compares with SimpleITK, OpenCV, scikit-image, pyrtcao and HCIPy (extra: peers) in some minutes. With --live it
    measures instead whether the window keeps up with 70 frames/s, and then the rate without window and disk. Refinement
    is off unless --set reconstruction.refine=true turns it on.

    Example: svwfs benchmark --live 60 --check
    """
    check_outputs([json], overwrite=overwrite)
    check_suffix(json, ".json")
    if live is not None:
        settings = (f"camera.exposure_s={_LIVE_EXPOSURE_S}", "reconstruction.refine=false", *(setting or ()))
        loaded = load(bench or _LIVE_BENCH, list(settings))
        folder = None if no_record else record_in or Path(gettempdir())
        _benchmark_live(loaded, live, folder, with_panels=panels, json=json, check=check)
        return
    if bench or setting or record_in or no_record or panels:
        raise InputError(
            "--bench, --set, --record-in, --no-record and --panels are only for the live benchmark: add --live SECONDS"
        )
    from app.cli.tables import progress_bar
    from app.evaluation.benchmark.baseline import load_baseline, worsened
    from app.evaluation.benchmark.benchmark_table import print_benchmark
    from app.evaluation.benchmark.run_benchmark import BenchmarkPlan, run_benchmark
    from app.evaluation.study_files import write_json

    plan = BenchmarkPlan(bench=load("paper_simulation", ["simulation.screen.correlation_length_m=1.6e-3"]))
    with progress_bar() as progress:
        result = run_benchmark(plan, progress)
    if json is not None:
        write_json(json, result)
    print_benchmark(result)
    if check and (slower := worsened(result["ratios"], load_baseline())):
        raise RunError("slower relative to the peers than the baseline: " + "; ".join(slower))


def _benchmark_live(
    bench: Bench, seconds: float, record_in: Path | None, *, with_panels: bool, json: Path | None, check: bool
) -> None:
    """Measure the live path, print and write the figures; with `check`, raise if a limit is missed."""
    from app.cli.tables import progress_bar
    from app.commands.acquisition_benchmark import benchmark_acquisition
    from app.evaluation.benchmark.live_path.figures import print_figures
    from app.evaluation.benchmark.live_path.plan import LivePlan
    from app.evaluation.study_files import write_json

    plan = LivePlan(bench=bench, seconds=seconds, record_in=record_in, with_panels=with_panels)
    with progress_bar() as progress:
        figures = benchmark_acquisition(plan, progress)
    print_figures(figures)
    if json is not None:
        write_json(json, figures.tree())
    if check and (failed := figures.missed()):
        raise RunError("missed: " + "; ".join(failed))


paper = typer.Typer(
    help="Reproduce the paper's tables beside its own numbers.", no_args_is_help=True, rich_markup_mode=None
)
OutOption = Annotated[Path, typer.Option(metavar=FOLDER, help="Folder for the table (JSON, CSV) and its figure.")]
PeersOption = Annotated[bool, typer.Option(help="Include the slow methods of SimpleITK (extra: peers).")]


@paper.command(cls=Command)
def table1(
    *,
    out: OutOption,
    seeds: SeedsOption = 1,
    peers: PeersOption = False,
    overwrite: OverwriteOption = False,
    bench: BenchOption = "paper_simulation",
    setting: SetOption = None,
) -> None:
    """Table 1: every method on the simulated bench, against the truth.

    Example: svwfs paper table1 --out paper
    """
    from app.evaluation.paper import paper_tables

    _run([paper_tables.table1(peers=peers)], load(bench, setting), seeds, out, overwrite=overwrite)


@paper.command(cls=Command)
def table2(
    *,
    out: OutOption,
    seeds: SeedsOption = 1,
    peers: PeersOption = False,
    overwrite: OverwriteOption = False,
    bench: BenchOption = "paper_experiment",
    setting: SetOption = None,
) -> None:
    """Table 2: every method on noisy frames of the experiment, against the stars.

    Example: svwfs paper table2 --seeds 3 --out paper
    """
    from app.evaluation.paper import paper_tables

    _run([paper_tables.table2(peers=peers)], load(bench, setting), seeds, out, overwrite=overwrite)


@paper.command(cls=Command)
def sources(
    *,
    out: OutOption,
    seeds: SeedsOption = 1,
    overwrite: OverwriteOption = False,
    bench: BenchOption = "paper_simulation",
    setting: SetOption = None,
) -> None:
    """The supplement's study of other source shapes.

    Example: svwfs paper sources --out paper
    """
    from app.evaluation.paper import paper_tables

    _run([paper_tables.sources()], load(bench, setting), seeds, out, overwrite=overwrite)
