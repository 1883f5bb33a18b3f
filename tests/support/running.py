"""An acquisition that runs on the small simulated bench."""

from __future__ import annotations

from collections.abc import Callable

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.measurement.measurement import Measurement
from drivers.interface import Devices
from simulated_devices.camera import SimulatedCamera
from support.patience import HANG_S, wait_until


class Running:
    """Acquisition on the small simulated bench, and its measurements."""

    def __init__(self, bench: Bench) -> None:
        self.devices: Devices | None = None
        self.measurements: list[Measurement] = []
        self.acquisition = Acquisition(bench, self._open, sinks=(self.measurements.append,))

    def _open(self, bench: Bench, progress: Callable[[float], None]) -> Devices:
        self.devices = open_devices(bench, progress)
        return self.devices

    @property
    def camera(self) -> SimulatedCamera:
        assert self.devices is not None
        assert isinstance(self.devices.camera, SimulatedCamera)
        return self.devices.camera

    @property
    def newest(self) -> Measurement:
        assert self.acquisition.newest is not None
        return self.acquisition.newest

    def begin(self) -> None:
        """Start up and wait for the first wavefront."""
        self.acquisition.start()
        for step in start_up(self.acquisition, 3):
            step.result(HANG_S)
        wait_until(lambda: bool(self.measurements))

    def end(self) -> None:
        """Stop the camera, or a last frame may be taken in the dark, and close."""
        self.acquisition.commands.submit(lambda instrument: instrument.devices.camera.stop()).result(HANG_S)
        self.acquisition.close()


def is_dark(instrument: Instrument) -> bool:
    """Return whether the light is off."""
    return not instrument.devices.light.is_on
