"""From devices that are just open to live wavefronts, without a click."""

from __future__ import annotations

from concurrent.futures import Future

from app.acquisition import Acquisition
from app.instrument import Instrument

FRAMES = 20  # averaged into the dark and into the reference


def start_up(acquisition: Acquisition, frames: int = FRAMES) -> tuple[Future[None], ...]:
    """Have the light turned on, a dark and a reference taken, the sample moved in and the camera started.

    The steps are executed in order; a cancelled one is left out, and the next one follows.
    """
    return (
        acquisition.submit(lambda instrument: instrument.devices.light.set_on(True)),
        acquisition.take_dark(frames),
        acquisition.take_reference(frames),
        acquisition.submit(_watch_sample),
    )


def _watch_sample(instrument: Instrument) -> None:
    instrument.devices.stage.set_sample_in(True)
    instrument.devices.camera.start()
