"""`svwfs benchmark`: speed beside other libraries, or of the live path with and without window and recording."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Annotated

import typer

from app.commands import options, terminal
from app.errors import InputError, RunError
from app.files import check_outputs, check_suffix
from app.progress import Progress, between, named

if TYPE_CHECKING:
    from app.bench.config import Bench
    from app.evaluation.benchmark.live_path.course import Course
    from app.evaluation.benchmark.live_path.figures import LiveFigures
    from app.evaluation.benchmark.live_path.plan import LivePlan
    from app.gui.shell.main_window import MainWindow

_LIVE_BENCH = "live_demo"
_LIVE_EXPOSURE_S = 0.014286  # 70 frames/s
_POLL_S = 0.1
_WARM_UP_S = 3.0  # maximum, of the run without a window, which measures no memory


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
        Path | None, typer.Option(metavar=options.FOLDER, help="With --live: folder of the temporary recording.")
    ] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="With --live: do not record.")] = False,
    panels: Annotated[
        bool, typer.Option("--panels", help="With --live: open coefficients, history and histogram, too.")
    ] = False,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help=f"With --live: simulated bench [default: {_LIVE_BENCH}]."),
    ] = None,
    overwrite: options.Overwrite = False,
    setting: options.Set = None,
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
        loaded = options.load(bench or _LIVE_BENCH, list(settings))
        folder = None if no_record else record_in or Path(gettempdir())
        _benchmark_live(loaded, live, folder, with_panels=panels, json=json, check=check)
        return
    if bench or setting or record_in or no_record or panels:
        raise InputError(
            "--bench, --set, --record-in, --no-record and --panels are only for the live benchmark: add --live SECONDS"
        )
    from app.evaluation.benchmark.baseline import load_baseline, worsened
    from app.evaluation.benchmark.benchmark_table import print_benchmark
    from app.evaluation.benchmark.run_benchmark import BenchmarkPlan, run_benchmark
    from app.evaluation.study_files import write_json

    plan = BenchmarkPlan(bench=options.load("paper_simulation", ["simulation.screen.correlation_length_m=1.6e-3"]))
    with terminal.progress_bar() as progress:
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
    from app.evaluation.benchmark.live_path.figures import print_figures
    from app.evaluation.benchmark.live_path.plan import LivePlan
    from app.evaluation.study_files import write_json

    plan = LivePlan(bench=bench, seconds=seconds, record_in=record_in, with_panels=with_panels)
    with terminal.progress_bar() as progress:
        figures = benchmark_acquisition(plan, progress)
    print_figures(figures)
    if json is not None:
        write_json(json, figures.tree())
    if check and (failed := figures.missed()):
        raise RunError("missed: " + "; ".join(failed))


def benchmark_acquisition(plan: LivePlan, progress: Progress) -> LiveFigures:
    """Measure both runs; without a display the window is drawn offscreen.

    The light is turned off and the recording removed, also on an error or Ctrl-C.
    """
    from app.acquisition.streams.publisher import stream_sinks
    from app.commands.live import use_display
    from app.evaluation.benchmark.live_path.course import Course
    from app.evaluation.benchmark.live_path.figures import LiveFigures
    from app.evaluation.benchmark.live_path.plan import recording_folder

    is_seen = use_display()
    warm_up_s = min(_WARM_UP_S, plan.warm_up_s)
    lasting_s = (plan.warm_up_s + plan.seconds, warm_up_s + plan.without_window_s)
    middle = lasting_s[0] / sum(lasting_s)
    in_window = named(between(progress, 0.0, middle), "window" if is_seen else "unseen window")
    with stream_sinks(plan.bench) as sinks:
        with recording_folder(plan, in_window) as folder:
            with_window = Course(
                plan.bench,
                in_window,
                warm_up_s=plan.warm_up_s,
                seconds=plan.seconds,
                memory_s=plan.memory_s,
                record_into=folder,
                sinks=sinks,
            )
            _run_in_window(with_window, with_panels=plan.with_panels)
        without_window = Course(
            plan.bench,
            named(between(progress, middle, 1.0), "no window"),
            warm_up_s=warm_up_s,
            seconds=plan.without_window_s,
            sinks=sinks,
        )
        _run(without_window)
    return LiveFigures(
        plan=plan,
        is_seen=is_seen,
        window=with_window.span,
        recording=with_window.acquisition.recording,
        bare=without_window.span,
    )


def _run_in_window(course: Course, *, with_panels: bool) -> None:
    from app.gui.application import run_window

    def open_course(window: MainWindow) -> None:
        if with_panels:
            panels = window.panels
            window.docks.float_panels(panels.coefficients, panels.history, panels.histogram)
        window.open(lambda: course.acquisition, lambda _: course.begin())

    run_window(None, until=course.poll, open_first=open_course, remembers=False)


def _run(course: Course) -> None:
    course.acquisition.start()
    try:
        course.begin()
        while not course.poll():
            time.sleep(_POLL_S)
    finally:
        course.acquisition.close()
