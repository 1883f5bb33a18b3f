"""How far to trust it, and how fast it is: `svwfs selftest`, `study` and `benchmark`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.options import BenchOption, SeedsOption, SetOption, load
from app.errors import RunError


def selftest() -> None:
    """Prove signs, axes and units on phases that are known in closed form."""
    from app.report import print_checks
    from app.selftest import run_checks

    if not print_checks(run_checks()):
        raise RunError("the selftest failed: this installation must not be trusted")


def study(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Sweeps; all without a name.")] = None,
    *,
    out: Annotated[Path, typer.Option(help="Folder for study.json, study.csv and estimator.png.")],
    seeds: SeedsOption = 3,
    bench: BenchOption = "paper_simulation",
    setting: SetOption = None,
) -> None:
    """What the estimator leaves of the truth, against everything that may be hard for it (docs/estimator.md)."""
    from app.report import progress_bar
    from app.study.output import print_study
    from app.study.sweeps import chosen_sweeps, run_study

    sweeps, loaded = chosen_sweeps(names or []), load(bench, setting)
    with progress_bar() as report:
        outcomes = run_study(loaded, sweeps, seeds, out, report)
    print_study(outcomes)


def benchmark(
    *,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write all numbers as JSON.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Fail if a ratio is 20 % worse than the one committed.")
    ] = False,
) -> None:
    """How fast it is beside SimpleITK, OpenCV, scikit-image, pyrtcao and HCIPy (svwfs[peers]); some minutes."""
    from app.benchmark.baseline import load_baseline, worsened
    from app.benchmark.output import print_benchmark, write_benchmark
    from app.benchmark.run import Plan, run_benchmark
    from app.report import progress_bar

    plan = Plan(bench=load("paper_simulation", ["simulation.screen.correlation_length_m=1.6e-3"]))
    with progress_bar() as report:
        result = run_benchmark(plan, report)
    if json is not None:
        write_benchmark(result, json)
    print_benchmark(result)
    if check and (said := worsened(result["ratios"], load_baseline())):
        raise RunError("slower beside the peers than before: " + "; ".join(said))
