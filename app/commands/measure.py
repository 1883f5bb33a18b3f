"""`svwfs measure`: a measurement without a window, from the dark to the results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.acquisition.address import NAME
from app.commands import options, terminal
from app.errors import InputError, Interrupted, RunError
from app.files import MEASURED
from app.measurement.averages import FRAMES
from app.progress import Progress, counted
from simulated_devices.settings import MASKS

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from app.acquisition.session import LiveBench
    from app.bench.config import Bench
    from app.results.run_summary import Measured


def measure(
    *,
    bench: Annotated[str | None, options.bench_option()] = None,
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of frames to measure.")],
    out: Annotated[Path, options.folder_option("New folder for the recording, with frames and results.nc.")],
    mask: Annotated[
        str | None, typer.Option(metavar="NAME", help=f"Mask in the beam: {', '.join(MASKS)} (simulation.source.mask).")
    ] = None,
    average: Annotated[int | None, options.average_option("dark and reference", FRAMES)] = None,
    auto_expose: Annotated[
        bool, typer.Option("--auto-expose", help="Find the exposure first, without the sample: bright, not saturated.")
    ] = False,
    overwrite: options.Overwrite = False,
    trust_library: options.Trust = False,
    setting: options.Set = None,
    attach: options.Attach = False,
    take_control: Annotated[
        bool, typer.Option("--take-control", help="Take control from the program that has it (--attach).")
    ] = False,
    name: options.Instrument = NAME,
) -> None:
    """Measure without a window: dark, reference, frames, results.

    It takes dark and reference, moves the sample in, records, and writes frames and results. On a bench
    without motors you are asked to move mask and sample. Average fewer long exposures, but at least 4, from which the
    camera's noise is estimated. Pinholes need centroids instead of a warp (second example). Ctrl-C ends early and saves
    everything. With --attach it records with the dark and the reference that the instrument has, and leaves light and
    sample as they are. See `svwfs docs results` for the folder, `svwfs docs first_measurement` for a whole experiment.

    Example: svwfs measure --bench live_demo --frames 20 --out run1

    Example: svwfs measure --bench paper_experiment --mask stars --set registration.method=centroids --set
    reconstruction.method=zonal --set camera.amplifier=normal --set camera.readout_speed=1 --set camera.exposure_s=3.8
    --average 4 --frames 10 --out stars

    Example: svwfs measure --attach --frames 100 --out run2
    """
    if attach:
        options.refuse_with_attach(bench=bench, mask=mask, average=average, auto_expose=auto_expose, set=setting)
        _check_files(out, (), overwrite=overwrite)  # before another program loses control
        with terminal.progress_bar() as progress:
            measured = measure_attached(name, out, frames=frames, progress=progress, takes_control=take_control)
    elif take_control:
        raise InputError("--take-control is for an instrument that runs: add --attach")
    elif bench is None:
        raise InputError("say what to measure with: --bench TOML, or --attach for an instrument that runs")
    else:
        mask_setting = [] if mask is None else [f"simulation.source.mask={mask}"]
        loaded = options.load(bench, [*(setting or []), *mask_setting])
        terminal.confirm_libraries(loaded, is_trusted=trust_library)
        _check_files(out, loaded.files, overwrite=overwrite)
        with terminal.progress_bar() as progress:
            measured = measure_bench(
                loaded, out, frames=frames, progress=progress, average=average, auto_expose=auto_expose
            )
    print_measurement(measured, out)


def measure_attached(name: str, out: Path, *, frames: int, progress: Progress, takes_control: bool = False) -> Measured:
    """Let the instrument of a name record `frames` frames, and write their results; see `measure_bench`."""
    from app.acquisition.remote.messages import watching
    from app.acquisition.session import ConnectedBench

    live = ConnectedBench("measure", name, progress=progress)

    def begin() -> None:
        if takes_control:
            live.take_control()
        elif live.controller and not live.has_control:
            raise RunError(f"{watching(live.controller)}, with --take-control")
        live.require_ready()

    return _measured(live, frames, out, progress, begin)


def measure_bench(
    bench: Bench, out: Path, *, frames: int, progress: Progress, average: int | None = None, auto_expose: bool = False
) -> Measured:
    """Record `frames` frames into the folder `out`, with the results, the dark and the reference.

    Dark and reference are means of `average` frames each, by default `FRAMES`; with `auto_expose` the exposure is found
    first. If it ends early, also by Ctrl-C, the results so far are written. `RunError` for a failed device or an
    unusable reference, `InputError` for an impossible bench.
    """
    from app.acquisition.session import LiveBench

    live = LiveBench(bench, average=0, progress=progress)

    def calibrate() -> None:
        live.calibrate(terminal.ask, average or FRAMES, auto_expose=auto_expose)

    try:
        return _measured(live, frames, out, progress, calibrate)
    finally:
        if bench.has_manual_light:
            terminal.remind(terminal.LIGHT_BY_HAND)


def _measured(live: LiveBench, frames: int, out: Path, progress: Progress, begin: Callable[[], object]) -> Measured:
    """Record with a live bench, and write the results."""
    from app.recording.folder import RUN, remove_empty
    from app.recording.reader import Recording
    from app.results.run_summary import write_measured
    from drivers.interface import DeviceError

    is_stopped, fault = False, ""
    try:
        with live:
            begin()
            live.record(out, frames, command="measure")
    except Interrupted:
        is_stopped = True
    except InputError:
        raise
    except Exception as error:
        if not (live.failure or isinstance(error, DeviceError | RunError)):
            raise
        fault = live.failure or str(error)
    recording = Recording(out) if (out / RUN).exists() else None
    if not recording:
        remove_empty(out)
        nothing = fault or "no frame was recorded"
        raise Interrupted("stopped before the first frame") if is_stopped else RunError(nothing)
    try:
        measured = write_measured(recording, live.bench, progress)
    except (Interrupted, RunError) as error:
        why = "stopped before the results were written" if isinstance(error, Interrupted) else fault or str(error)
        raise type(error)(
            f"{why}: {out} holds {counted(len(recording))}; svwfs replay {out} --out FILE computes the results"
        ) from error
    if is_stopped:
        raise Interrupted(f"stopped: {measured.reconstructed} of {frames} frames are in {out}")
    if fault:
        raise RunError(fault)
    if not measured.reconstructed:
        raise RunError(f"no frame could be reconstructed: {measured.problem or 'none was recorded'}")
    return measured


def _check_files(out: Path, inputs: Collection[Path], *, overwrite: bool) -> None:
    from app.recording.folder import check_free

    check_free(out)
    options.check_files(*(out / name for name in MEASURED), reads=inputs, overwrite=overwrite)


def print_measurement(measured: Measured, out: Path) -> None:
    """Print mean, scatter and error bar of each view's RMS over the frames, and the results' folder."""
    import numpy as np

    from app.results.run_summary import rms_text

    has_scatter = measured.reconstructed > 1
    of = f", mean +- scatter of {measured.reconstructed} frames" if has_scatter else " +- error bar"
    errors_rad = measured.scatter_rms_rad if has_scatter else measured.noise_rad
    rows = zip(measured.means[0], errors_rad, measured.noise_rad, strict=True)
    cells = (
        (
            rms_text(mean, noise) if mean < noise else f"{mean:.3f} +- {error:.3f}"
            for mean, error, noise in zip(*row, strict=True)
        )
        for row in rows
    )
    terminal.print_by_view(measured.bench.field, f"RMS (rad) of the wavefront{of}", cells)
    bar_rad = np.nanmean(measured.noise_rad)
    terminal.print_sentence(f"error bar of one frame: {bar_rad:.3f} rad; assumed: {measured.assumed}")
    light = "" if measured.light_current_a is None else f", light current {measured.light_current_a:.4g} A"
    simulated = "; camera and light are simulated" if measured.bench.is_simulated else ""
    terminal.print_sentence(f"exposure {measured.exposure_s * 1e3:.4g} ms{light}{simulated}")
    if measured.mask_note:
        terminal.print_sentence(measured.mask_note)
    failed = measured.frames - measured.reconstructed
    why = f", {failed} not reconstructed ({measured.problem})" if failed else ""
    if measured.rotation is not None:
        terminal.print_rotation(measured.rotation, is_rotating=2 * measured.rotating > measured.reconstructed)
    terminal.print_quality(measured.quality)
    counts = f"{counted(measured.frames)}{why}, {measured.lost} lost by the camera; all is in {out}"
    terminal.print_sentence(counts)
