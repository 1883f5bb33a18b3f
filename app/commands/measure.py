"""`svwfs measure`: a measurement without a window, from the dark to the results."""

from __future__ import annotations

import time
from collections.abc import Iterable
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.commands import options, terminal
from app.errors import InputError, Interrupted, RunError
from app.files import check_outputs
from app.progress import Progress, counted

if TYPE_CHECKING:
    from app.acquisition.worker import Acquisition
    from app.bench.config import Bench
    from app.results.frame_tallies import Measured

_POLL_S = 0.05


def measure(
    *,
    bench: options.Bench,
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of frames to measure.")],
    out: Annotated[
        Path,
        typer.Option(metavar=options.FOLDER, help="New folder for the recording, with results.nc beside the frames."),
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
    overwrite: options.Overwrite = False,
    trust_library: options.Trust = False,
    setting: options.Set = None,
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
    loaded = options.load(bench, [*(setting or []), *([] if mask is None else [f"simulation.source.mask={mask}"])])
    terminal.confirm_libraries(loaded, trust=trust_library)
    with terminal.progress_bar() as progress:
        measured = measure_bench(
            loaded, frames, out, progress, average=average, auto_expose=auto_expose, overwrite=overwrite
        )
    print_measurement(measured, out)


def measure_bench(
    bench: Bench,
    frames: int,
    out: Path,
    progress: Progress,
    *,
    average: int | None = None,
    auto_expose: bool = False,
    overwrite: bool = False,
) -> Measured:
    """Record `frames` frames into the folder `out`, with the results, the dark and the reference.

    Dark and reference are means of `average` frames each, by default 20; with `auto_expose` the exposure is found
    first. If it ends early, also by Ctrl-C, the results so far are written. `RunError` for a failed device or an
    unusable reference, `InputError` for an impossible bench, a folder that holds a recording, or results that exist
    without `overwrite`.
    """
    from app.acquisition.devices import open_devices
    from app.acquisition.start_up import FRAMES
    from app.acquisition.streams.publisher import stream_sinks
    from app.acquisition.worker import Acquisition
    from app.recording.folder import RUN, check_free, remove_empty
    from app.recording.reader import Recording
    from app.results.frame_tallies import files_of, write_measured
    from drivers.interface import DeviceError

    check_free(out)
    check_outputs(files_of(out), inputs=bench.files, overwrite=overwrite)
    is_stopped, fault = False, ""
    with stream_sinks(bench) as sinks:
        acquisition = Acquisition(bench, open_devices, sinks)
        acquisition.start()
        try:
            _calibrate(acquisition, bench, average or FRAMES, progress, auto_expose=auto_expose)
            _record(acquisition, bench, frames, out, progress)
        except Interrupted:
            is_stopped = True
        except DeviceError as error:
            fault = str(acquisition.error or error)
        finally:
            acquisition.close()
            if bench.has_manual_light:
                terminal.remind(terminal.LIGHT_BY_HAND)
    if isinstance(acquisition.error, InputError):
        raise acquisition.error
    state = acquisition.recording
    fault = fault or acquisition.failure or ("" if state is None else state.problem)
    recording = Recording(out) if (out / RUN).exists() else None
    if not recording:
        remove_empty(out)
        raise (
            Interrupted("stopped before the first frame") if is_stopped else RunError(fault or "no frame was recorded")
        )
    try:
        measured = write_measured(recording, bench, progress)
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


def _calibrate(acquisition: Acquisition, bench: Bench, average: int, progress: Progress, *, auto_expose: bool) -> None:
    """Take dark and reference; without motors, ask the user to move mask and sample.

    An unusable reference is reported before the sample is moved.
    """
    from app.acquisition.start_up import calibrate

    if bench.has_manual_stage:
        terminal.ask(f"take the sample out of the beam, put the mask {bench.simulation.source.mask} in")
    if bench.has_manual_light:
        _calibrate_by_hand(acquisition, average, progress, auto_expose=auto_expose)
    else:
        _wait(calibrate(acquisition, average, auto_expose=auto_expose), acquisition, progress)
    while problem := acquisition.submit(lambda made: "" if made.calibration else made.status().warning).result():
        sentence = f"the reference is unusable: {problem}"
        if not bench.has_manual_stage:
            raise RunError(sentence)
        terminal.ask(f"{sentence}; check light, mask and focus, the sample out of the beam")
        _wait([acquisition.take_reference(average)], acquisition, progress)
    if bench.has_manual_stage:
        terminal.ask("put the sample into the beam")


def _calibrate_by_hand(acquisition: Acquisition, average: int, progress: Progress, *, auto_expose: bool) -> None:
    """Take dark and reference while the user switches the light."""

    def switch(word: str) -> None:
        terminal.ask(f"switch the light {word}")
        acquisition.submit(lambda instrument: instrument.devices.light.note_light(word == "on")).result()

    if auto_expose:
        switch("on")
        _wait([acquisition.auto_expose()], acquisition, progress)
    switch("off")
    _wait([acquisition.take_dark(average)], acquisition, progress)
    switch("on")
    _wait([acquisition.take_reference(average)], acquisition, progress)


def _record(acquisition: Acquisition, bench: Bench, frames: int, out: Path, progress: Progress) -> None:
    """Record from the first frame of which sample and correction are known; of played frames from the first one."""
    from app.acquisition.start_up import knows_sample, move_sample_in, start_camera
    from app.bench.device_kinds import RecordingSettings
    from app.recording.recorder import Limit

    def begin() -> Future[None]:
        return acquisition.start_recording(out, command="measure", limit=Limit(frames=frames))

    moved = move_sample_in(acquisition)
    if isinstance(bench.camera, RecordingSettings) or not acquisition.submit(lambda made: made.prepares).result():
        _wait([moved, begin(), start_camera(acquisition)], acquisition, progress)  # no frame comes before it records
    else:
        _wait([moved, start_camera(acquisition)], acquisition, progress)
        while acquisition.is_alive and not knows_sample(acquisition):
            progress("finding layers and correction with the first frames", 0.0)
            time.sleep(_POLL_S)
        _wait([begin()], acquisition, progress)
    while acquisition.is_alive and (state := acquisition.recording) is not None and state.stage == "recording":
        progress(f"recording {counted(frames)}", state.frames / frames)
        time.sleep(_POLL_S)


def _wait(steps: Iterable[Future[Any]], acquisition: Acquisition, progress: Progress) -> None:
    for step in steps:
        while not step.done():
            progress(acquisition.activity.text, acquisition.activity.progress)
            time.sleep(_POLL_S)
        step.result()


def print_measurement(measured: Measured, out: Path) -> None:
    """Print mean and scatter of every view's RMS over the frames, its error bar, and the folder of the results."""
    import numpy as np

    from app.results.frame_tallies import rms_text

    has_scatter = measured.reconstructed > 1
    of = f", mean +- scatter of {measured.reconstructed} frames" if has_scatter else " +- error bar"
    errors_rad = measured.scatter_rms_rad if has_scatter else measured.noise_rad
    rows = zip(measured.mean_rms_rad, errors_rad, measured.noise_rad, strict=True)
    cells = (
        (
            rms_text(mean, noise) if mean < noise else f"{mean:.3f} +- {error:.3f}"
            for mean, error, noise in zip(*row, strict=True)
        )
        for row in rows
    )
    terminal.print_by_view(measured.bench.field, f"RMS (rad) of the wavefront{of}", cells)
    terminal.print_sentence(
        f"error bar of one frame: {np.nanmean(measured.noise_rad):.3f} rad; assumed: {measured.assumed}"
    )
    light = "" if measured.light_current_a is None else f", light current {measured.light_current_a:.4g} A"
    terminal.print_sentence(f"exposure {measured.exposure_s * 1e3:.4g} ms{light}")
    if measured.mask_note:
        terminal.print_sentence(measured.mask_note)
    failed = measured.recorded - measured.reconstructed
    why = f", {failed} not reconstructed ({measured.problem})" if failed else ""
    if measured.rotation is not None:
        terminal.print_rotation(measured.rotation, rotates=2 * measured.rotating > measured.reconstructed)
    terminal.print_quality(measured.quality)
    counts = f"{counted(measured.recorded)}{why}, {measured.lost} lost by the camera; all is in {out}"
    terminal.print_sentence(counts)
