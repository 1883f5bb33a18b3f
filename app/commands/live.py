"""`svwfs live`: the window on a bench or a recording, attended or not."""

import sys
from dataclasses import asdict
from pathlib import Path

from app.acquisition.devices import open_devices
from app.acquisition.start_up import start_up
from app.acquisition.streams.publisher import stream_sinks
from app.acquisition.worker import Acquisition, Measurement
from app.bench.config import Bench
from app.commands.display import use_display
from app.commands.prompt import LIGHT_BY_HAND, remind
from app.errors import InputError
from app.files import check_outputs, make_folder
from app.recording.folder import FRAME_LINES
from app.results.dataset import result_dataset, write_results
from app.results.replay.player import Player
from app.run_facts import now, software_facts, timing_facts, write_record

_UNATTENDED_S = 5.0


def live_window(
    bench: Bench, *, seconds: float | None, out: Path, overwrite: bool, player: Player | None = None
) -> int:
    """Run the window and return the exit status; a `player` replaces the bench's devices by a recording.

    Without a display, or with `seconds`, the window closes by itself that time after the first wavefront and writes
    `window.png`, `result.nc` and `run.json` into the folder `out`; without a wavefront it fails.
    """
    if not use_display():
        seconds = seconds or _UNATTENDED_S
    picture, results, run = (out / name for name in ("window.png", "result.nc", "run.json"))
    if seconds is not None:
        if (out / FRAME_LINES).exists():
            raise InputError(f"{out}: holds a recording; choose another folder with --out")
        check_outputs([picture, results, run], overwrite=overwrite)
    from app.gui.application import run_window

    made: list[Acquisition] = []  # one more after each reconnection

    def finish(measurement: Measurement) -> None:
        _write_run(run, made[-1])
        if measurement.wavefront is not None:
            dataset = result_dataset(measurement.wavefront, measurement.quality)
            write_results(results, dataset, bench=bench, inputs={})

    with stream_sinks(bench) as sinks:

        def make() -> Acquisition:
            if player is None:
                made.append(Acquisition(bench, open_devices, sinks))
            else:
                made.append(Acquisition(bench, player.open_devices, (player.take, *sinks)))
            return made[-1]

        begin = start_up if player is None else player.begin
        if seconds is None:
            status = run_window(make, begin=begin, player=player)
            if bench.has_manual_light:
                remind(LIGHT_BY_HAND)
            return status
        make_folder(out)
        status = run_window(make, offscreen_s=seconds, screenshot=picture, on_finish=finish, begin=begin, player=player)
    sys.stdout.write(f"screenshot: {picture}\nresults: {results}\ntimings: {run}\n")
    return status


def _write_run(path: Path, acquisition: Acquisition) -> None:
    """Write `run.json` of a run without a recording: numbers of frames and stage times."""
    shown = acquisition.timings.summary()["draw"].count
    record = {
        "command": "live",
        "ended": now(),
        "frames": {**asdict(acquisition.counts), "shown": shown},
        "timings": timing_facts(acquisition.timings),
        **software_facts(),
    }
    write_record(path, record)
