"""`svwfs live`: the window on a bench or a recording, attended or not."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.acquisition.address import NAME, NameTaken, file_of
from app.bench.config import load_bench
from app.bench.presets import DEFAULT
from app.bench.trusted_libraries import unconfirmed
from app.cache import loading
from app.commands import options, terminal
from app.commands.display import use_display
from app.errors import InputError
from app.files import make_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from app.acquisition.remote.connection import RunningInstrument
    from app.acquisition.remote.own_connection import OwnConnection
    from app.acquisition.remote.own_instrument import OwnInstrument
    from app.bench.config import Bench
    from app.gui.shell.main_window import MainWindow
    from app.measurement.measurement import FrameTotals, Measurement
    from app.results.player import InstrumentFactory
    from app.timing import StageTimes, TimedStage

_LIVE_OUT = Path("svwfs-output")
_UNATTENDED_S = 8.0  # layers are found six to seven seconds after the first wavefront


def live(
    *,
    bench: Annotated[str | None, options.bench_option(f"Bench TOML file or preset [default: {DEFAULT}].")] = None,
    setting: options.Set = None,
    replay: Annotated[Path | None, typer.Option(metavar="RECORDING", help="Play a recording at its own rate.")] = None,
    frames: options.Frames = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=86400,
            metavar="SECONDS",
            help="Close by itself SECONDS after the first wavefront, saving the results.",
        ),
    ] = None,
    out: Annotated[
        Path, options.folder_option("Folder for screenshot, results and timings, with --seconds or without a display.")
    ] = _LIVE_OUT,
    overwrite: options.Overwrite = False,
    trust_library: options.Trust = False,
    attach: options.Attach = False,
    name: options.Instrument = NAME,
) -> None:
    """Open the window with live wavefronts at every field position.

    The instrument is a second process, which keeps running if the window hangs or is killed: `svwfs docs sharing`.
    Without a display it runs offscreen for a few seconds and saves a screenshot and the results. --replay plays a
    recording with its own bench unless --bench or --set changes it; --frames selects a part.

    Example: svwfs live --bench live_demo --set registration.warp=affine

    Example: svwfs live --attach
    """
    is_attended, overrides = use_display() and seconds is None, tuple(setting or ())
    if attach:
        options.refuse_with_attach(bench=bench, set=setting, replay=replay, frames=frames)
    elif replay is None and frames is not None:
        raise InputError("--frames selects frames of a recording: add --replay RECORDING")
    elif replay is None and is_attended:
        offers_last = bench is None and not setting
        raise typer.Exit(bench_window(bench or DEFAULT, overrides, name, trust=trust_library, offers_last=offers_last))
    from app.results.player import InstrumentFactory, Player

    if attach:
        loaded, access = _attached(name)
    elif replay is None:
        from app.acquisition.worker import Acquisition

        loaded = options.load(bench or DEFAULT, setting)
        terminal.confirm_libraries(loaded, is_trusted=trust_library)
        access = InstrumentFactory(partial(Acquisition, loaded))
    else:
        player = Player(replay, bench=bench, settings=overrides, frames=frames)
        loaded, access = player.bench, InstrumentFactory(player.acquisition, player.begin, player)
    if is_attended:
        from app.acquisition.remote.own_instrument import OwnInstrument

        with OwnInstrument(name) as own:  # for a bench that is opened in the window
            status = _run(lambda window: window.open(access), own)
        raise typer.Exit(status)
    raise typer.Exit(headless_window(loaded, access, seconds=seconds, out=out, overwrite=overwrite))


def bench_window(source: str, overrides: tuple[str, ...], name: str, *, trust: bool, offers_last: bool) -> int:
    """Run the window on a bench file or a preset until it is closed, and return the exit status.

    The instrument is a second process, which other clients find by its name. The window shows what is wrong with
    the file, and opens others; it may offer the one that was open last. `InputError` if only `overrides` are wrong.
    """
    from app.acquisition.remote.own_instrument import OwnInstrument
    from app.gui.widgets.theme import styled_application

    _application = styled_application()  # before the instrument: the display may be unusable
    with OwnInstrument(name) as own:
        try:
            bench = load_bench(source, overrides)
            if not unconfirmed(bench):
                with suppress(NameTaken):  # the window offers that instrument
                    own.start(bench)  # while the window is loaded
        except InputError:
            if overrides and _is_sound(source):
                raise  # what --set says is wrong; of a file, the window says more

        def open_first(window: MainWindow) -> None:
            window.benches.open(source, overrides, is_trusted=trust)
            if offers_last:
                window.benches.offer_last()

        return _run(open_first, own)


def _is_sound(source: str) -> bool:
    """True if a bench file or a preset can be read without changes."""
    try:
        load_bench(source)
    except InputError:
        return False
    return True


def _run(open_first: Callable[[MainWindow], object], own: OwnInstrument) -> int:
    """Run a window that opens benches in a second process; remind of a manual light."""
    with loading():
        from app.gui.application import run_window

    opened: list[OwnConnection] = []

    def make_for(bench: Bench) -> RunningInstrument:
        opened.append(own.connect(bench))
        return opened[-1]

    status = run_window(open_first, make_for=make_for, name=own.name)
    if opened and opened[-1].goes_on:
        place = opened[-1].address
        terminal.print_sentence(
            f"the instrument keeps running as process {place.process}; its messages go to {file_of(place.name, 'log')}"
        )
    elif opened and opened[-1].bench.has_manual_light:
        terminal.remind(terminal.LIGHT_BY_HAND)
    return status


def _attached(name: str) -> tuple[Bench, InstrumentFactory]:
    """Return the bench of an instrument of another process, and the window's access to it."""
    from app.acquisition.remote.connection import Connection, reach
    from app.results.player import InstrumentFactory

    first = reach("window", name)  # before there is a window: if none runs, the terminal says

    def connect() -> Connection:
        return first if first.is_alive else reach("window", name)

    return first.bench, InstrumentFactory(connect, begin=lambda _: ())  # it runs already


def headless_window(
    bench: Bench, access: InstrumentFactory, *, seconds: float | None, out: Path, overwrite: bool
) -> int:
    """Run the window until `seconds` after the first wavefront; write its files to `out`, return the exit status."""
    from app.recording.folder import FRAME_LINES
    from app.results.dataset import result_dataset
    from app.results.result_file import write_results

    picture, results, run = (out / name for name in ("window.png", "result.nc", "run.json"))
    if (out / FRAME_LINES).exists():
        raise InputError(f"{out}: holds a recording; choose another folder with --out")
    options.check_files(picture, results, run, reads=bench.files, overwrite=overwrite)
    from app.acquisition.start_up import HeadlessRun
    from app.gui.application import headless_steps, run_window

    def finish(acquisition: RunningInstrument, measurement: Measurement, times: dict[TimedStage, StageTimes]) -> None:
        _write_run(run, acquisition.counts, times)
        if measurement.wavefront is not None:
            dataset = result_dataset(measurement.wavefront, measurement.quality)
            status = acquisition.status
            in_force = bench if status is None else status.bench_in_force  # with the lattice found
            write_results(results, dataset, bench=in_force, inputs={})

    make_folder(out)
    headless = HeadlessRun(access.make())
    of_run = replace(access, make=lambda: headless.acquisition, begin=lambda _: headless.send(access.begin))
    status = run_window(
        lambda window: window.open(of_run),
        steps=lambda window: headless_steps(window, headless, seconds or _UNATTENDED_S, picture, finish),
    )
    sys.stdout.write(f"screenshot: {picture}\nresults: {results}\ntimings: {run}\n")
    return status


def _write_run(path: Path, counts: FrameTotals, times: dict[TimedStage, StageTimes]) -> None:
    """Write `run.json` of a run without a recording: numbers of frames and stage times."""
    from app.run_facts import now, software_facts, timing_facts, write_record

    record = {
        "command": "live",
        "ended": now(),
        "frames": {**asdict(counts), "shown": times["draw"].count},
        "timings": timing_facts(times),
        **software_facts(),
    }
    write_record(path, record)
