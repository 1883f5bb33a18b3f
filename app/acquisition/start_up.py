"""Start-up sequence from opened devices to live wavefronts."""

from concurrent.futures import Future
from typing import Any

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition
from app.bench.config import Bench

FRAMES = 20  # default number averaged into the dark, and into the reference


def acquisition_of(bench: Bench) -> Acquisition:
    """Make the acquisition of a bench; its results are not published."""
    return Acquisition(bench, open_devices)


def start_up(acquisition: Acquisition, frames: int = FRAMES, *, auto_expose: bool = False) -> tuple[Future[Any], ...]:
    """Turn the light on, take a dark and a reference, move the sample in and start the camera.

    The steps run in order; cancelling one skips only that one. With a manual stage the position of the sample is
    unknown: the camera starts after the dark, and the user requests the reference. With `auto_expose` the exposure is
    found first.
    """
    if acquisition.bench.has_manual_stage:
        return (
            acquisition.submit(_turn_light_on),
            *([acquisition.auto_expose()] if auto_expose else []),
            acquisition.take_dark(frames),
            start_camera(acquisition),
        )
    return (
        *calibrate(acquisition, frames, auto_expose=auto_expose),
        move_sample_in(acquisition),
        start_camera(acquisition),
    )


def calibrate(acquisition: Acquisition, frames: int = FRAMES, *, auto_expose: bool = False) -> tuple[Future[Any], ...]:
    """Turn the light on, take a dark and a reference.

    With `auto_expose` the exposure is found first, without the sample, so that the reference is not saturated.
    """
    steps: list[Future[Any]] = [acquisition.submit(_turn_light_on)]
    if auto_expose:
        steps += [acquisition.submit(_take_sample_out), acquisition.auto_expose()]
    return (*steps, acquisition.take_dark(frames), acquisition.take_reference(frames))


def move_sample_in(acquisition: Acquisition) -> Future[None]:
    """Move the sample in; with a manual stage, note that the user has done so."""
    return acquisition.submit(lambda instrument: instrument.devices.stage.note_sample(True))


def start_camera(acquisition: Acquisition) -> Future[None]:
    """Start the camera: frames are measured from now on."""
    return acquisition.submit(lambda instrument: instrument.devices.camera.start())


def knows_sample(acquisition: Acquisition) -> bool:
    """True if sample and correction of the newest frame are known, if it has any.

    It stays false with few frames: the first search takes some seconds, the first correction some more.
    """
    newest = acquisition.newest
    if newest is None or not newest.counts.acquired:
        return False
    return newest.assumed.sample is not None and newest.assumed.refinement.stage != "preparing"


def _turn_light_on(instrument: Instrument) -> None:
    instrument.devices.light.set_on(True)


def _take_sample_out(instrument: Instrument) -> None:
    instrument.devices.stage.set_sample_in(False)
