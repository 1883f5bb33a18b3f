"""Commands at the bench: `svwfs live`, `measure` and `devices`."""

from pathlib import Path
from typing import Annotated

import typer

from app.cli.command import FOLDER
from app.cli.options import BenchOption, FramesOption, OverwriteOption, SetOption, TrustOption, load
from app.errors import InputError

_LIVE_OUT = Path("svwfs-output")
_LIVE_BENCH = "live_demo"


def live(
    *,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help=f"Bench TOML file or preset [default: {_LIVE_BENCH}]."),
    ] = None,
    setting: SetOption = None,
    replay: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Play a recording repeatedly at its own rate.")
    ] = None,
    frames: FramesOption = None,
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
        Path, typer.Option(metavar=FOLDER, help="For screenshot, results and timings of such a run.")
    ] = _LIVE_OUT,
    overwrite: OverwriteOption = False,
    trust_library: TrustOption = False,
) -> None:
    """Open the window with live wavefronts at every field position.

    Without a display it runs offscreen for a few seconds and saves a screenshot and the results. --replay plays a
    recording with its own bench unless --bench or --set changes it; --frames selects a part.

    Example: svwfs live --bench live_demo --set registration.warp=affine
    """
    from app.commands.display import use_display
    from app.commands.live import bench_window, replay_window, unattended_window
    from app.commands.trust import confirm_libraries

    is_attended = use_display() and seconds is None
    if replay is None:
        if frames is not None:
            raise InputError("--frames selects frames of a recording: add --replay RECORDING")
        if is_attended:
            offers_last = bench is None and not setting
            source, overrides = bench or _LIVE_BENCH, tuple(setting or ())
            raise typer.Exit(bench_window(source, overrides, trust=trust_library, offers_last=offers_last))
        loaded = load(bench or _LIVE_BENCH, setting)
        confirm_libraries(loaded, trust=trust_library)
        raise typer.Exit(unattended_window(loaded, seconds=seconds, out=out, overwrite=overwrite))
    from app.results.player import Player

    player = Player(replay, bench=bench, settings=tuple(setting or ()), frames=frames)
    if is_attended:
        raise typer.Exit(replay_window(player))
    raise typer.Exit(unattended_window(player.bench, seconds=seconds, out=out, overwrite=overwrite, player=player))


def measure(
    *,
    bench: BenchOption,
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of frames to measure.")],
    out: Annotated[
        Path, typer.Option(metavar=FOLDER, help="New folder for the recording, with results.nc beside the frames.")
    ],
    mask: Annotated[
        str | None, typer.Option(metavar="NAME", help="Mask in the beam, as simulation.source.mask: square, stars, ...")
    ] = None,
    average: Annotated[
        int | None,
        typer.Option(min=1, max=10_000, help="Number of frames averaged into dark and reference [default: 20]."),
    ] = None,
    auto_expose: Annotated[
        bool, typer.Option("--auto-expose", help="Find the exposure first, without the sample: bright, not saturated.")
    ] = False,
    overwrite: OverwriteOption = False,
    trust_library: TrustOption = False,
    setting: SetOption = None,
) -> None:
    """Measure without a window: dark, reference, frames, results.

    It takes dark and reference, moves the sample in, records, and writes the results beside the frames. On a bench
    without motors you are asked to move mask and sample. Average fewer long exposures, but at least 4, from which the
    camera's noise is estimated. Pinholes need centroids instead of a warp (second example). Ctrl-C ends early and keeps
    everything. See docs/recording.md for the folder and docs/experiment.md for a whole experiment.

    Example: svwfs measure --bench live_demo --frames 20 --out run1

    Example: svwfs measure --bench paper_experiment --mask stars --set registration.method=centroids --set
    reconstruction.method=zonal --set camera.amplifier=normal --set camera.readout_speed=1 --set camera.exposure_s=3.8
    --average 4 --frames 10 --out stars
    """
    from app.acquisition.start_up import FRAMES
    from app.cli.tables import print_measurement, progress_bar
    from app.commands.measure import measure as run
    from app.commands.trust import confirm_libraries

    loaded = load(bench, [*(setting or []), *([] if mask is None else [f"simulation.source.mask={mask}"])])
    confirm_libraries(loaded, trust=trust_library)
    with progress_bar() as progress:
        measured = run(
            loaded, frames, out, progress, average=average or FRAMES, auto_expose=auto_expose, overwrite=overwrite
        )
    print_measurement(measured, out)


def desktop(
    *,
    bench: Annotated[
        str | None, typer.Option("--bench", "-b", metavar="TOML", help="Bench file or preset that the entry opens.")
    ] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Remove the entry.")] = False,
) -> None:
    """Add svwfs to the menu of a Linux desktop, for the present user.

    The entry starts svwfs-window: the window without a terminal, with errors in a dialog.

    Example: svwfs desktop --bench bench.toml
    """
    from app.commands.desktop import add_entry, remove_entry

    if remove:
        remove_entry()
    else:
        typer.echo(f"entry: {add_entry(bench)}")


def devices(
    *,
    check: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Test everything that this device, named as in the list, must be able to do, and print a report that"
            " can be published: versions, what was tried, what was answered, timings. A light shines during the test,"
            " with at most 5 % of its range.",
        ),
    ] = None,
    bench: Annotated[
        str | None,
        typer.Option(
            "--bench",
            "-b",
            metavar="TOML",
            help="With --check camera or --check light: that device of this bench, with its settings.",
        ),
    ] = None,
    trust_library: TrustOption = False,
    serial_numbers: Annotated[
        bool, typer.Option("--serial-numbers", help="With --check: do not hide serial numbers in the report.")
    ] = False,
    setting: SetOption = None,
) -> None:
    """List the connected cameras and lights.

    Each is shown with its section of a bench file and with what is missing to use it. Listing switches nothing on. See
    docs/hardware.md for how to connect each. The devices of the presets are simulated: check those of your own bench.

    Example: svwfs devices

    Example: svwfs devices --check light --bench bench.toml
    """
    from app.commands.devices import check_and_print, print_devices
    from app.commands.trust import confirm_libraries

    if check is None and bench is None:
        print_devices()
    elif check is None:
        raise InputError("--bench needs --check camera or --check light")
    else:
        loaded = None if bench is None else load(bench, setting)
        if loaded is not None:
            confirm_libraries(loaded, trust=trust_library)
        check_and_print(check, loaded, serial_numbers=serial_numbers)
