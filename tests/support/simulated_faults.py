"""Faults of the simulated devices: a pulled plug, a missing answer, a refused setting, frames that do not come."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from drivers.interface import BadValue, Camera, Device, DeviceError, DeviceTimeout, Disconnected, Frame
from simulated_devices.bench import SimulatedLight
from simulated_devices.camera import SimulatedCamera

_OF_LIGHT = ("_read_range", "_read_current", "_is_lit", "_set_current", "_switch")
_ANSWERS = ("_read_current", "_is_lit", "_set_current")
_OF_CAMERA = ("exposure", "em_gain", "amplifier", "readout_speed", "region")


def unplug(device: Device) -> None:
    """Pull the plug; a light goes out."""
    gone = Disconnected(f"the {device._kind} does not answer; is it plugged in and switched on?")
    if isinstance(device, SimulatedLight):
        device._bench.change(is_light_on=False)
        _fail(device, _OF_LIGHT, gone)
        return

    @contextmanager
    def access() -> Iterator[None]:
        with type(device)._access(device):
            raise gone
        yield

    device._access = access  # type: ignore[method-assign] # injected fault


def plug_in(device: Device) -> None:
    """Mend all faults."""
    for name in ("_access", "_read", "_start", *_OF_LIGHT):
        vars(device).pop(name, None)


def refuse_next(device: Device) -> None:
    """Refuse the next setting."""
    settings = [f"_set_{name}" for name in _OF_CAMERA] if isinstance(device, Camera) else ["_set_current"]
    _fail(device, settings, BadValue(f"the {device._kind} refused the setting"), once=True)


def fail_next(light: SimulatedLight) -> None:
    """Leave the next request without an answer."""
    _fail(light, _ANSWERS, DeviceTimeout("the light did not answer in time"), once=True)


def is_calm(light: SimulatedLight) -> bool:
    """True if no fault is to come."""
    return not any(name in vars(light) for name in _OF_LIGHT)


def stall(camera: SimulatedCamera) -> None:
    """Deliver no further frame until the camera is started again."""

    def read(timeout_s: float) -> Frame:
        camera._bench.clock.sleep(timeout_s)
        raise DeviceTimeout("no frame came in time")

    def start() -> None:
        plug_in(camera)
        camera._start()

    camera._read, camera._start = read, start  # type: ignore[method-assign] # injected fault


def lose_frames(camera: SimulatedCamera, count: int) -> None:
    """Lose the next frames."""
    camera._next_index += count


def _fail(device: Device, hooks: list[str] | tuple[str, ...], error: DeviceError, *, once: bool = False) -> None:
    """Let some methods of a device raise."""

    def raising(*_: object, **__: object) -> None:
        if once:
            for hook in hooks:
                vars(device).pop(hook, None)
        raise error

    for hook in hooks:
        setattr(device, hook, raising)
