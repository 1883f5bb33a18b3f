"""Commands for the camera that the worker executes for the window."""

from contextlib import suppress

from drivers.interface import BadValue, Camera, Devices


def set_running(devices: Devices, running: bool) -> None:
    """Start or stop the camera."""
    if running and not devices.camera.is_running:
        devices.camera.start()
    elif not running:
        devices.camera.stop()


class CameraModes:
    """Changes amplifier and readout speed; a camera that returns to a mode gets its exposure and gain back."""

    def __init__(self) -> None:
        self._left: dict[tuple[str, int], tuple[float, float]] = {}  # exposure and gain by amplifier and speed

    def set_amplifier(self, devices: Devices, amplifier: str) -> str:
        """Change the amplifier; return what else changed, or an empty text."""
        return self._change(devices.camera, amplifier, None)

    def set_readout_speed(self, devices: Devices, readout_speed: int) -> str:
        """Change the readout speed; return what else changed, or an empty text."""
        return self._change(devices.camera, None, readout_speed)

    def _change(self, camera: Camera, amplifier: str | None, readout_speed: int | None) -> str:
        exposure_s, em_gain = self._left[_mode(camera)] = camera.exposure_s, camera.em_gain
        with camera.paused():
            if amplifier is not None:
                camera.set_amplifier(amplifier)
            if readout_speed is not None:
                camera.set_readout_speed(readout_speed)
            if known := self._left.get(_mode(camera)):
                with suppress(BadValue):  # the region may have changed the limits
                    camera.set_exposure(known[0])
                    camera.set_em_gain(known[1])
        changes = (
            ("exposure", exposure_s * 1e3, camera.exposure_s * 1e3, " ms"),
            ("gain", em_gain, camera.em_gain, ""),
        )
        return ", ".join(
            f"{what} changed from {before:.4g} to {after:.4g}{unit}"
            for what, before, after, unit in changes
            if f"{before:.4g}" != f"{after:.4g}"
        )


def _mode(camera: Camera) -> tuple[str, int]:
    return camera.amplifier, camera.readout_speed
