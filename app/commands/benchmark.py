"""`svwfs benchmark`: speed of the reconstruction, or of the live path."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.bench.presets import DEFAULT, PAPER
from app.commands import options, terminal
from app.errors import InputError, RunError
from app.progress import Progress, between, named

if TYPE_CHECKING:
    from app.evaluation.live_path import LiveFigures, LivePlan, MeasuredRun, Span
    from app.gui.shell.main_window import MainWindow

_LIVE_EXPOSURE_S = 0.014286  # 70 frames/s
_POLL_S = 0.1
_LEAST_MS = 0.02  # of processor time in a frame, for which a thread is listed


def benchmark(
    *,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="JSON file for all numbers.")] = None,
    check: Annotated[bool, typer.Option("--check", help="With --live: fail if a limit is missed.")] = False,
    live: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Measure the live path instead for SECONDS, with window and recording; typically 60.",
        ),
    ] = None,
    record_in: Annotated[Path | None, options.folder_option("With --live: folder of the temporary recording.")] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="With --live: do not record.")] = False,
    panels: Annotated[
        bool, typer.Option("--panels", help="With --live: open coefficients, history and histogram, too.")
    ] = False,
    bench: Annotated[str | None, options.bench_option(f"With --live: simulated bench [default: {DEFAULT}].")] = None,
    overwrite: options.Overwrite = False,
    setting: options.Set = None,
) -> None:
    """Measure the speed of the reconstruction.

    It times registration and solve of a frame with the quadratic warp, for lattices of up to 100 x 100 lenslets, and
    the search for layers, in some minutes. With --live it measures instead whether the window keeps up with 70
    frames/s, and then the rate without window and disk. Refinement is off unless --set reconstruction.refine=true turns
    it on. `python -m studies contestants`, in a checkout, compares with other software.

    Example: svwfs benchmark --live 60 --check
    """
    from app.run_facts import write_record

    options.check_files(json, suffixes=(".json",), overwrite=overwrite)
    if live is not None:
        from app.evaluation.live_path import LivePlan

        settings = (f"camera.exposure_s={_LIVE_EXPOSURE_S}", "reconstruction.refine=false", *(setting or ()))
        loaded = options.load(bench or DEFAULT, list(settings))
        folder = None if no_record else record_in or Path(gettempdir())
        live_plan = LivePlan(bench=loaded, seconds=live, record_in=folder, with_panels=panels)
        with terminal.progress_bar() as progress:
            figures = benchmark_acquisition(live_plan, progress)
        print_figures(figures)
        numbers, missed = figures.tree(), figures.missed()
    elif bench or setting or record_in or no_record or panels or check:
        raise InputError(
            "--bench, --set, --record-in, --no-record, --panels and --check are only for the live benchmark: add --live"
            " SECONDS"
        )
    else:
        from app.evaluation.benchmark import run_benchmark

        loaded = options.load(PAPER, ["simulation.screen.correlation_length_m=1.6e-3"])
        with terminal.progress_bar() as progress:
            numbers, missed = run_benchmark(loaded, progress), []
        print_benchmark(numbers)
    if json is not None:
        write_record(json, numbers)
    if check and missed:
        raise RunError(f"missed: {'; '.join(missed)}")


def benchmark_acquisition(plan: LivePlan, progress: Progress) -> LiveFigures:
    """Measure both runs; without a display the window is drawn offscreen.

    The light is turned off and the recording removed, also on an error or Ctrl-C.
    """
    from app.acquisition.remote.own_instrument import OwnInstrument
    from app.commands.display import use_display
    from app.evaluation.live_path import LiveFigures, MeasuredRun, recording_folder
    from app.evaluation.processor_time import total_s

    is_seen = use_display()
    middle = (plan.warm_up_s + plan.seconds) / plan.lasting_s
    in_window = named(between(progress, 0.0, middle), "window" if is_seen else "unseen window")
    with recording_folder(plan, in_window) as folder, OwnInstrument("benchmark") as own:
        with_window = MeasuredRun(
            own.connect(plan.bench),
            in_window,
            warm_up_s=plan.warm_up_s,
            seconds=plan.seconds,
            memory_s=plan.memory_s,
            record_into=folder,
        )
        _run_in_window(with_window, with_panels=plan.with_panels)
    alone = named(between(progress, middle, 1.0), "no window")
    with OwnInstrument("benchmark") as own, closing(own.connect(plan.bench)) as acquisition:
        warm_up_s, seconds = plan.bare_warm_up_s, plan.without_window_s
        without_window = MeasuredRun(acquisition, alone, warm_up_s=warm_up_s, seconds=seconds)
        acquisition.start()
        without_window.send()
        for _ in without_window.steps():
            time.sleep(_POLL_S)
    return LiveFigures(
        plan=plan,
        is_seen=is_seen,
        window=with_window.span,
        recording=with_window.acquisition.recording,
        bare=without_window.span,
        processor_s=total_s(),
    )


def _run_in_window(run: MeasuredRun, *, with_panels: bool) -> None:
    from app.gui.application import run_window
    from app.gui.shell.instrument_factory import InstrumentFactory

    def open_run(window: MainWindow) -> None:
        if with_panels:
            panels = window.panels
            window.docks.float_panels(panels.coefficients, panels.history, panels.histogram)
        window.open(InstrumentFactory(lambda: run.acquisition, lambda _: run.send()))

    run_window(open_run, steps=lambda _: run.steps())


def print_benchmark(result: dict[str, Any]) -> None:
    """Print the times of one frame and of growing lattices."""
    machine = result["machine"]
    terminal.print_sentence(f"{machine['processor'] or machine['system']}, {machine['cores']} cores")
    headings = ["lenslets", "px", "register", "solve", "one frame, ms", "frames/s", "each lenslet, us", "prepare, s"]
    lines = [
        [
            f"{each['lenslets']} x {each['lenslets']}",
            f"{each['frame_px']}",
            *(f"{each[name] * 1e3:.2f}" for name in ("register_s", "solve_s", "frame_s")),
            f"{each['frames_per_s']:.0f}",
            f"{each['per_lenslet_us']:.1f}",
            f"{each['prepare_s']:.1f}",
        ]
        for each in result["lattices"]
    ]
    terminal.print_table(None, headings, lines, [f"search for layers {result['layer_search_s']:.2f} s"])


def print_figures(figures: LiveFigures) -> None:
    """Print every figure beside its limit."""
    from app.run_facts import machine_facts
    from app.timing import KEPT

    machine, recording, span = machine_facts(), figures.recording, figures.window
    camera, sensor = figures.plan.bench.camera_model, figures.plan.bench.sensor
    terminal.print_sentence(f"{machine['processor'] or machine['system']}, {machine['cores']} cores")
    terminal.print_sentence(
        f"{camera.rows} x {camera.columns} pixels, {sensor.lenslet_rows} x {sensor.lenslet_columns} lenslets,"
        f" {1 / camera.exposure_s:.1f} frames/s, {'recorded' if recording else 'not recorded'},"
        f" {span.seconds:.0f} s after a warm-up"
    )
    terminal.print_sentence(
        "the window was on a display" if figures.is_seen else "no display: the window was drawn offscreen"
    )
    lines = []
    for name, measured, limit in figures.lines():
        colour = "[green]met[/]" if limit and limit.is_met else "[red]missed[/]"
        lines.append([name, measured, *((limit.asked, colour) if limit else ("", ""))])
    notes = [f"Times are median / 99 % of the newest {KEPT} / longest since the start."]
    notes += [f"Longest pause of the {pause}." for pause in span.pauses()]
    if recording is not None and recording.problem:
        notes.append(f"The recording ended early: {recording.problem}")
    terminal.print_table(None, ("live", "measured", "asked", ""), lines, notes)
    if span.processor_s and span.frames.acquired:
        _print_processor_times(span)


def _print_processor_times(span: Span) -> None:
    """Print the processor time of every process and its threads."""
    lines = []
    for process, threads in span.processor_s.items():
        named = sorted(threads.items(), key=lambda item: (item[0] != "", -item[1]))
        for thread, seconds in named:
            ms = 1e3 * seconds / span.frames.acquired
            if not thread or ms >= _LEAST_MS:
                lines.append((f"  {thread}" if thread else process, f"{ms:.2f}", f"{100 * seconds / span.seconds:.1f}"))
    notes = [f"Of it, the simulated camera takes {1e3 * span.camera_s / span.frames.acquired:.2f} ms; a real one none."]
    terminal.print_table(None, ("processor time", "ms per frame", "% of a core"), lines, notes)
