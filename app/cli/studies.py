"""How far to trust it, and how fast it is: `svwfs selftest`, `study` and `benchmark`."""

from __future__ import annotations

from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.options import BenchOption, SeedsOption, SetOption, load
from app.errors import InputError, RunError

if TYPE_CHECKING:
    from app.bench.config import Bench

_LIVE_BENCH = "live_demo"
_LIVE_EXPOSURE_S = 0.014286  # 70 frames/s


def selftest() -> None:
    """Prove signs, axes and units on phases that are known in closed form."""
    from app.cli.tables import print_checks
    from app.evaluation.selftest import run_checks

    if not print_checks(run_checks()):
        raise RunError("the selftest failed: this installation must not be trusted")


def study(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Sweeps, or calibration or exposure; all sweeps without a name."),
    ] = None,
    *,
    out: Annotated[Path, typer.Option(help="Folder for tables and figure: JSON, CSV and PNG.")],
    seeds: SeedsOption = 3,
    bench: BenchOption = "paper_simulation",
    setting: SetOption = None,
) -> None:
    """What the estimator leaves of the truth, against everything that may be hard for it (docs/estimator.md).

    `calibration` tries how well lattices are found, `exposure` how soon the exposure is (docs/calibration.md).
    """
    from app.cli.tables import progress_bar
    from app.evaluation.study.sweeps import chosen_sweeps, print_outcomes, run_study

    sweeps, loaded = chosen_sweeps(names or []), load(bench, setting)
    with progress_bar() as progress:
        outcomes = run_study(loaded, sweeps, seeds, out, progress)
    print_outcomes(outcomes)


def benchmark(
    *,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write all numbers as JSON.")] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Fail if a ratio is 20 % worse than the one committed; with --live, if a limit is missed."
        ),
    ] = False,
    live: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", help="Measure the live path instead, for so long: window open, recording on. Usually 60."
        ),
    ] = None,
    record_in: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="With --live: where the recording lies until it is removed.")
    ] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="With --live: record nothing.")] = False,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help=f"With --live: another simulated bench than {_LIVE_BENCH}."),
    ] = None,
    setting: SetOption = None,
) -> None:
    """How fast it is beside SimpleITK, OpenCV, scikit-image, pyrtcao and HCIPy (the extra peers); some minutes.

    With --live it measures instead how the window keeps up with 70 frames/s, then the rate without window and disk.
    Nothing is refined meanwhile, unless --set reconstruction.refine=true says so.
    """
    if live is not None:
        settings = (f"camera.exposure_s={_LIVE_EXPOSURE_S}", "reconstruction.refine=false", *(setting or ()))
        loaded = load(bench or _LIVE_BENCH, list(settings))
        _benchmark_live(loaded, live, None if no_record else record_in or Path(gettempdir()), json=json, check=check)
        return
    if bench or setting or record_in or no_record:
        raise InputError("--bench, --set, --record-in and --no-record say how --live SECONDS is measured: give it, too")
    from app.cli.tables import progress_bar
    from app.evaluation.benchmark.baseline import load_baseline, worsened
    from app.evaluation.benchmark.output import print_benchmark, write_benchmark
    from app.evaluation.benchmark.run import Plan, run_benchmark

    plan = Plan(bench=load("paper_simulation", ["simulation.screen.correlation_length_m=1.6e-3"]))
    with progress_bar() as progress:
        result = run_benchmark(plan, progress)
    if json is not None:
        write_benchmark(result, json)
    print_benchmark(result)
    if check and (said := worsened(result["ratios"], load_baseline())):
        raise RunError("slower beside the peers than before: " + "; ".join(said))


def _benchmark_live(bench: Bench, seconds: float, record_in: Path | None, *, json: Path | None, check: bool) -> None:
    """Measure the live path under a progress bar, print and write what was found; `check` it if asked to."""
    from app.cli.tables import progress_bar
    from app.commands.live_benchmark import live_benchmark
    from app.evaluation.benchmark.live.output import live_json, missed, print_live
    from app.evaluation.benchmark.live.plan import LivePlan
    from app.evaluation.benchmark.output import write_benchmark

    plan = LivePlan(bench=bench, seconds=seconds, record_in=record_in)
    with progress_bar() as progress:
        figures = live_benchmark(plan, progress)
    print_live(figures)
    if json is not None:
        write_benchmark(live_json(figures), json)
    if check and (said := missed(figures)):
        raise RunError("missed: " + "; ".join(said))
