"""What is done at the bench: `svwfs live` and `svwfs measure`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.options import BenchOption, FramesOption, SetOption, load
from app.errors import InputError

_LIVE_OUT = Path("svwfs-output")
_LIVE_BENCH = "live_demo"


def live(
    *,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help=f"A bench TOML file, or a preset; {_LIVE_BENCH}."),
    ] = None,
    setting: SetOption = None,
    replay: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Show a recording at its own pace, again and again.")
    ] = None,
    frames: FramesOption = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.1, max=86400, help="Close by itself so long after the first wavefront, leaving a screenshot."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the screenshot and the results of such a run.")] = _LIVE_OUT,
) -> None:
    """Open the window: live wavefronts at every field position. Without a display it runs unseen for a few seconds.

    With --replay it shows a recording, by its own bench unless --bench or --set say otherwise, and --frames some of it.
    """
    from app.commands.live import live_window

    if replay is None:
        if frames is not None:
            raise InputError("--frames says which frames of a recording are meant: give --replay RECORDING")
        raise typer.Exit(live_window(load(bench or _LIVE_BENCH, setting), seconds=seconds, out=out))
    from app.results.replay.player import Player

    player = Player(replay, bench=bench, settings=tuple(setting or ()), frames=frames)
    raise typer.Exit(live_window(player.bench, seconds=seconds, out=out, player=player))


def measure(
    *,
    bench: BenchOption,
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="How many frames to measure.")],
    out: Annotated[Path, typer.Option(help="Folder that becomes a recording, with results.nc beside the frames.")],
    mask: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="The mask in the beam, for simulation.source.mask: square, stars, ..."),
    ] = None,
    average: Annotated[
        int | None,
        typer.Option(min=1, max=10_000, help="How many frames make the dark, and the reference; 20 unless said."),
    ] = None,
    auto_expose: Annotated[
        bool, typer.Option("--auto-expose", help="Find the exposure first, without the sample: bright, not saturated.")
    ] = False,
    setting: SetOption = None,
) -> None:
    """Measure without a window: dark, reference, sample in, so many frames recorded, results.

    On a bench without motors you are asked to move the mask and the sample. Long exposures: average fewer frames, but
    at least 4, which tell the camera's noise. Pinholes are compared by their centroids, not by a warp:

    svwfs measure --bench B.toml --mask stars --set registration.method=centroids --set reconstruction.method=zonal
    --set camera.amplifier=normal --set camera.exposure_s=3.8 --average 4 --frames 10 --out stars

    Ctrl-C ends it early and keeps everything; docs/recording.md says what is in the folder, docs/experiment.md leads
    through a whole experiment.
    """
    from app.acquisition.start_up import FRAMES
    from app.cli.tables import print_measurement, progress_bar
    from app.commands.measure import measure as run

    loaded = load(bench, [*(setting or []), *([] if mask is None else [f"simulation.source.mask={mask}"])])
    with progress_bar() as progress:
        measured = run(loaded, frames, out, progress, average=average or FRAMES, auto_expose=auto_expose)
    print_measurement(measured, out)
