"""From devices that are just open to live wavefronts, without a click."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition

FRAMES = 20  # averaged into the dark and into the reference


def start_up(acquisition: Acquisition, frames: int = FRAMES, *, auto_expose: bool = False) -> tuple[Future[Any], ...]:
    """Have the light turned on, a dark and a reference taken, the sample moved in and the camera started.

    The steps are executed in order; a cancelled one is left out, and the next one follows. On a bench that is worked by
    hand nobody knows yet where the sample is: the camera starts after the dark, and a person asks for the reference.
    With `auto_expose` the exposure is found first.
    """
    if acquisition.bench.is_worked_by_hand:
        return (
            acquisition.submit(_turn_light_on),
            *([acquisition.auto_expose()] if auto_expose else []),
            acquisition.take_dark(frames),
            acquisition.submit(lambda instrument: instrument.devices.camera.start()),
        )
    return (*calibrate(acquisition, frames, auto_expose=auto_expose), watch_sample(acquisition))


def calibrate(acquisition: Acquisition, frames: int = FRAMES, *, auto_expose: bool = False) -> tuple[Future[Any], ...]:
    """Have the light turned on, a dark and a reference taken.

    With `auto_expose` the exposure is found before, without the sample: the reference must not be saturated.
    """
    steps: list[Future[Any]] = [acquisition.submit(_turn_light_on)]
    if auto_expose:
        steps += [acquisition.submit(_take_sample_out), acquisition.auto_expose()]
    return (*steps, acquisition.take_dark(frames), acquisition.take_reference(frames))


def watch_sample(acquisition: Acquisition) -> Future[None]:
    """Have the sample in the beam, moved there now or before by hand, and the camera started."""

    def watch(instrument: Instrument) -> None:
        instrument.devices.stage.note_sample(True)
        instrument.devices.camera.start()

    return acquisition.submit(watch)


def _turn_light_on(instrument: Instrument) -> None:
    instrument.devices.light.set_on(True)


def _take_sample_out(instrument: Instrument) -> None:
    instrument.devices.stage.set_sample_in(False)
