"""Settings of all cameras and lights that a bench can have, told apart by their driver."""

from typing import Any, TypeAlias, get_args, get_type_hints

from app.bench.settings import RecordingSettings
from drivers.dcam.settings import DcamSettings
from drivers.genicam.settings import GenicamSettings
from drivers.manual_light import ManualLightSettings
from drivers.micro_manager.settings import MicroManagerSettings
from drivers.serial_lights.settings import CoolLEDSettings, DC4100Settings
from drivers.usb_lights.settings import DC2200Settings
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
