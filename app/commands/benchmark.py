"""`svwfs benchmark`: speed of the reconstruction, or of the live path."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
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
    from app.acquisition.start_up import HeadlessRun
    from app.evaluation.live_path import LiveFigures, LivePlan, Span
    from app.gui.shell.main_window import MainWindow

_RATE_HZ = 70.0
_LIGHT_A = 0.35  # at that rate; as many photons fall into a frame at others
_POLL_S = 0.1
_SLOWEST_HZ, _FASTEST_HZ = 5.0, 2000.0


def benchmark(
    *,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="JSON file for all numbers.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Fail if a limit of --live is missed.")] = False,
    live: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Measure the live path instead for SECONDS, with window and recording; typically 60.",
        ),
    ] = None,
    record_in: Annotated[Path | None, options.folder_option("With --live: folder of the temporary recording.")] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="Do not record during --live.")] = False,
    panels: Annotated[bool, typer.Option("--panels", help="Open coefficients, history, histogram in --live.")] = False,
    rendered: Annotated[
        bool,
        typer.Option("--rendered", help="Frames of --live from memory, at the cost of a copy as from a real camera."),
    ] = False,
    camera_rate: Annotated[
        float | None, typer.Option(min=_SLOWEST_HZ, max=_FASTEST_HZ, help="Frames/s of --live [default: 70].")
    ] = None,
    bench: Annotated[str | None, options.bench_option(f"With --live: simulated bench [default: {DEFAULT}].")] = None,
    overwrite: options.Overwrite = False,
    setting: options.Set = None,
) -> None:
    """Measure the speed of the reconstruction.

    It times registration and solve of a frame with the quadratic warp, for lattices of up to 100 x 100 lenslets, and
    the search for layers, in some minutes. With --live it measures instead whether the window follows 70
    frames/s, and then the rate without window and disk. Refinement is off unless --set reconstruction.refine=true turns
    it on. `python -m studies contestants`, in a checkout, compares with other software.

    Example: svwfs benchmark --live 60 --check
    """
    from app.run_facts import write_record

    options.check_files(json, suffixes=(".json",), overwrite=overwrite)
    if live is not None:
        from app.evaluation.live_path import LivePlan

        rate_hz = camera_rate or _RATE_HZ
        settings = [
            "reconstruction.refine=false",
            f"camera.exposure_s={1 / rate_hz:.6f}",
            f"camera.shortest_exposure_s={1 / _FASTEST_HZ}",
            f"camera.noise_frames={2 if rendered else 0}",
            f"light.current_a={_LIGHT_A * rate_hz / _RATE_HZ:g}",
            f"light.maximum_current_a={_LIGHT_A * _FASTEST_HZ / _RATE_HZ:g}",
        ]
        loaded = options.load(bench or DEFAULT, [*settings, *(setting or ())])
        folder = None if no_record else record_in or Path(gettempdir())
        plan = LivePlan(bench=loaded, seconds=live, record_in=folder, with_panels=panels)
        with terminal.progress_bar() as progress:
            figures = benchmark_acquisition(plan, progress)
        print_figures(figures)
        numbers, missed = figures.tree(), figures.missed()
    elif bench or setting or record_in or no_record or panels or rendered or camera_rate or check:
        raise InputError(
            "--bench, --set, --record-in, --no-record, --panels, --rendered, --camera-rate and --check are only for the"
            " live benchmark: add --live SECONDS"
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
    """Measure both runs, offscreen without a display; turn the light off and remove the recording on errors, too."""
    from app.acquisition.remote.own_instrument import OwnInstrument
    from app.acquisition.start_up import HeadlessRun
    from app.commands.display import use_display
    from app.evaluation.live_path import LiveFigures, measure_span, recording_folder
    from app.evaluation.processor_time import total_s
    from app.gui.widgets.theme import styled_application

    is_seen, middle = use_display(), (plan.warm_up_s + plan.seconds) / plan.lasting_s
    spans: list[Span] = []
    _application = styled_application()  # before the instrument: the display may be unusable

    def noting(steps: Generator[None, None, Span]) -> Iterator[None]:
        spans.append((yield from steps))

    in_window = named(between(progress, 0.0, middle), "window" if is_seen else "unseen window")
    with recording_folder(plan, in_window) as folder, OwnInstrument("benchmark") as own:
        run = HeadlessRun(own.connect(plan.bench), in_window)
        steps = measure_span(run, time.perf_counter(), plan.warm_up_s, plan.seconds, folder)
        _run_in_window(run, noting(steps), with_panels=plan.with_panels)
    recording = run.acquisition.recording
    with OwnInstrument("benchmark") as own, closing(own.connect(plan.bench)) as acquisition:
        run = HeadlessRun(acquisition, named(between(progress, middle, 1.0), "no window"))
        acquisition.start()
        run.send()
        for _ in noting(measure_span(run, time.perf_counter(), *plan.bare_s)):
            time.sleep(_POLL_S)
    window, bare = spans
    return LiveFigures(plan=plan, is_seen=is_seen, window=window, recording=recording, bare=bare, processor_s=total_s())


def _run_in_window(run: HeadlessRun, steps: Iterator[None], *, with_panels: bool) -> None:
    from app.gui.application import run_window
    from app.results.player import InstrumentFactory

    def open_run(window: MainWindow) -> None:
        if with_panels:
            panels = window.panels
            window.docks.float_panels(panels.coefficients, panels.history, panels.histogram)
        window.open(InstrumentFactory(lambda: run.acquisition, lambda _: run.send()))

    run_window(open_run, steps=lambda _: steps)


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
    """Print every figure next to its limit."""
    from app.run_facts import machine_facts
    from app.timing import KEPT

    machine, recording, span = machine_facts(), figures.recording, figures.window
    camera, sensor = figures.plan.bench.camera_model, figures.plan.bench.sensor
    terminal.print_sentence(f"{machine['processor'] or machine['system']}, {machine['cores']} cores")
    terminal.print_sentence(
        f"{camera.rows} x {camera.columns} pixels, {' x '.join(map(str, sensor.lenslets))} lenslets,"
        f" {1 / camera.exposure_s:.1f} frames/s, {'recorded' if recording else 'not recorded'},"
        f" {span.seconds:.0f} s after a warm-up"
    )
    terminal.print_sentence("the window was on a display" if figures.is_seen else "no display: it was drawn offscreen")
    lines = [
        (each.name, each.measured, each.asked, each.key and ("[green]met[/]" if each.is_met else "[red]missed[/]"))
        for each in figures.rows()
    ]
    notes = [f"Times are median / 99 % of the newest {KEPT} / longest since the recording began."]
    if recording is not None and recording.problem:
        notes.append(f"The recording ended early: {recording.problem}")
    terminal.print_table(None, ("live", "measured", "asked", ""), lines, notes)
    if span.processor_s and span.frames.acquired:
        lines = [
            (
                process,
                f"{1e3 * seconds / span.frames.acquired:.2f}",
                f"{100 * seconds / span.seconds:.1f}",
                f"{span.memory_mb[1].get(process, 0.0):.0f}",
            )
            for process, seconds in span.processor_s.items()
        ]
        terminal.print_table(None, ("processor time", "ms per frame", "% of a core", "MB"), lines)
