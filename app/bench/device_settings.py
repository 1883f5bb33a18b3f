"""Settings of all cameras and lights that a bench can have, told apart by their driver."""

from typing import Any, TypeAlias, get_args, get_type_hints

from app.bench.settings import RecordingSettings
from drivers.manual_light import ManualLightSettings
from drivers.settings import (
    CoolLEDSettings,
    DC2200Settings,
    DC4100Settings,
    DcamSettings,
    GenicamSettings,
    MicroManagerSettings,
)
from simulated_devices.settings import SimulatedCameraSettings, SimulatedLightSettings

CameraSettings: TypeAlias = (
    SimulatedCameraSettings | DcamSettings | GenicamSettings | MicroManagerSettings | RecordingSettings
)
LightSettings: TypeAlias = (
    SimulatedLightSettings | DC4100Settings | DC2200Settings | CoolLEDSettings | ManualLightSettings
)


def drivers_of(kind: Any) -> dict[str, type]:
    """Return the settings classes of a union by driver name."""
    return {get_args(get_type_hints(each)["driver"])[0]: each for each in get_args(kind)}
