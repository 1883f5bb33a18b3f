"""From devices that are just open to live wavefronts, without a click."""

from __future__ import annotations

from concurrent.futures import Future

from app.acquisition import Acquisition
from app.instrument import Instrument

FRAMES = 20  # averaged into the dark and into the reference


def start_up(acquisition: Acquisition, frames: int = FRAMES) -> tuple[Future[None], ...]:
    """Have the light turned on, a dark and a reference taken, the sample moved in and the camera started.

    The steps are executed in order; a cancelled one is left out, and the next one follows. On a bench that is worked by
    hand nobody knows yet where the sample is: the camera starts after the dark, and a person asks for the reference.
    """
    if not acquisition.bench.is_simulated:
        return (
            acquisition.submit(_turn_light_on),
            acquisition.take_dark(frames),
            acquisition.submit(lambda instrument: instrument.devices.camera.start()),
        )
    return (*calibrate(acquisition, frames), watch_sample(acquisition))


def calibrate(acquisition: Acquisition, frames: int = FRAMES) -> tuple[Future[None], ...]:
    """Have the light turned on, a dark and a reference taken."""
    return (acquisition.submit(_turn_light_on), acquisition.take_dark(frames), acquisition.take_reference(frames))


def watch_sample(acquisition: Acquisition) -> Future[None]:
    """Have the sample in the beam, moved there now or before by hand, and the camera started."""

    def watch(instrument: Instrument) -> None:
        instrument.devices.stage.note_sample(True)
        instrument.devices.camera.start()

    return acquisition.submit(watch)


def _turn_light_on(instrument: Instrument) -> None:
    instrument.devices.light.set_on(True)
