"""The supported cameras and lights: an entry for each driver."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, Literal

from typing_extensions import Doc

from drivers.dcam import DcamSettings
from drivers.device import DiscoveredDevice
from drivers.errors import DeviceError
from drivers.genicam import GenicamSettings
from drivers.light_source import ManualLightSettings
from drivers.micro_manager import MicroManagerSettings
from drivers.serial_lights import CoolLEDSettings, DC4100Settings
from drivers.usb_lights import DC2200Settings
from simulated_devices.settings import SimulatedCameraSettings, SimulatedLightSettings

Pace = Literal["own", "fastest"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSettings:
    """A recording in place of the devices."""

    driver: Literal["recording"] = "recording"
    folder: str
    pace: Annotated[Pace, Doc("Frame rate: as recorded (own), or each frame when it is read (fastest)")] = "own"
    repeat: Annotated[bool, Doc("Whether the recording starts again after its last frame")] = False


CameraSettings = SimulatedCameraSettings | DcamSettings | GenicamSettings | MicroManagerSettings | RecordingSettings
LightSettings = SimulatedLightSettings | DC4100Settings | DC2200Settings | CoolLEDSettings | ManualLightSettings
DeviceSettings = CameraSettings | LightSettings


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """A driver. Its module, imported when needed, has the device's class and `discover`."""

    settings: Any  # their class
    device: str = ""  # module and class; empty: not opened on its own
    name: str = ""  # for people; empty: that of the driver
    heading: str = ""  # in the list of connected devices; empty: not searched for
    package: str = ""  # of Python, through which the device is called; others report their library as a property

    @property
    def driver(self) -> str:
        """Name of the driver in a bench."""
        return str(self.settings.__dataclass_fields__["driver"].default)

    def open(self, settings: DeviceSettings) -> Any:
        """Open the device."""
        module, _, name = self.device.rpartition(".")
        return getattr(import_module(module), name)(settings)

    def discover(self) -> tuple[tuple[DiscoveredDevice, ...], str]:
        """Return the connected devices, and what is missing to search for them, if anything."""
        try:
            return import_module(self.device.rpartition(".")[0]).discover(), ""
        except DeviceError as error:
            return (), str(error)


def _by_driver(kinds: Iterable[DeviceKind]) -> Mapping[str, DeviceKind]:
    return {kind.driver: kind for kind in kinds}


_CAMERAS = (
    DeviceKind(SimulatedCameraSettings),
    DeviceKind(DcamSettings, "drivers.dcam.camera.DcamCamera", "Hamamatsu (DCAM)", "Hamamatsu cameras, over DCAM-API"),
    DeviceKind(
        GenicamSettings,
        "drivers.genicam.camera.GenicamCamera",
        "GigE and USB3 Vision (GenICam)",
        "GigE Vision and USB3 Vision cameras, over Aravis",
    ),
    DeviceKind(
        MicroManagerSettings,
        "drivers.micro_manager.camera.MicroManagerCamera",
        "Micro-Manager",
        "Cameras of other makers, over Micro-Manager",
        "pymmcore",
    ),
    DeviceKind(RecordingSettings),
)
_LIGHTS = (
    DeviceKind(SimulatedLightSettings),
    DeviceKind(
        DC4100Settings,
        "drivers.serial_lights.thorlabs_dc4100.ThorlabsDC4100",
        "Thorlabs DC4100",
        "Thorlabs DC4100 and DC4104 LED drivers, on serial ports",
        "pyserial",
    ),
    DeviceKind(
        DC2200Settings,
        "drivers.usb_lights.thorlabs_dc2200.ThorlabsDC2200",
        "Thorlabs DC2200",
        "Thorlabs DC2200 LED drivers, on USB",
        "pyusb",
    ),
    DeviceKind(
        CoolLEDSettings,
        "drivers.serial_lights.coolled.CoolLED",
        "CoolLED",
        "CoolLED pE-300, pE-340fura and pE-4000, on serial ports",
        "pyserial",
    ),
    DeviceKind(ManualLightSettings, "drivers.light_source.ManualLight"),
)
DRIVERS = {"camera": _by_driver(_CAMERAS), "light": _by_driver(_LIGHTS)}  # by section of a bench and name
KINDS = tuple(kind for kinds in DRIVERS.values() for kind in kinds.values() if kind.heading)
