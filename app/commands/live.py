"""The window on a bench, with a person before it or without: `svwfs live`."""

from __future__ import annotations

import sys
from pathlib import Path

from app.acquisition.devices import open_devices
from app.acquisition.run_record import write_run
from app.acquisition.start_up import start_up
from app.acquisition.streams.publisher import stream_sinks
from app.acquisition.worker import Acquisition, Measurement
from app.bench.config import Bench
from app.commands.display import use_display
from app.files import make_folder
from app.results.dataset import result_dataset, write_results
from app.results.replay.player import Player

_UNATTENDED_S = 5.0


def live_window(bench: Bench, *, seconds: float | None, out: Path, player: Player | None = None) -> int:
    """Run the window and return the exit status; Qt is loaded here, when it is known that a window is wanted.

    With a `player` it shows a recording in place of the bench's devices.

    Where there is no display, or `seconds` are given, nobody needs to be there: it closes by itself so long after
    the first wavefront and leaves `window.png`, `result.nc` and `run.json` in the folder `out`; without them it ends
    with an error.
    """
    if not use_display():
        seconds = seconds or _UNATTENDED_S
    from app.gui.application import run_window

    made: list[Acquisition] = []  # another one after each reconnection

    def finish(measurement: Measurement) -> None:
        write_run(out / "run.json", "live", made[-1])
        if measurement.wavefront is not None:
            write_results(out / "result.nc", result_dataset(measurement.wavefront), bench=bench, inputs={})

    with stream_sinks(bench) as sinks:

        def make() -> Acquisition:
            if player is None:
                made.append(Acquisition(bench, open_devices, sinks))
            else:
                made.append(Acquisition(bench, player.open_devices, (player.take, *sinks)))
            return made[-1]

        begin = start_up if player is None else player.begin
        if seconds is None:
            return run_window(make, begin=begin)
        make_folder(out)
        status = run_window(
            make,
            offscreen_s=seconds,
            screenshot=out / "window.png",
            on_finish=finish,
            begin=begin,
        )
    sys.stdout.write(f"screenshot: {out / 'window.png'}\nresults: {out / 'result.nc'}\ntimings: {out / 'run.json'}\n")
    return status
