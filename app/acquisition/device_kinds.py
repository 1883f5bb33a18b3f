"""The supported kinds of devices, and the search for those that are connected."""

from dataclasses import dataclass
from importlib import import_module

from drivers.device import DiscoveredDevice
from drivers.errors import DeviceError


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """A supported kind of devices, and the module that discovers them."""

    name: str
    driver: str  # as in a bench
    module: str  # has a function `discover`; imported when it is needed
    package: str = ""  # of Python, through which the device is called; others report their library as a property

    def discover(self) -> tuple[tuple[DiscoveredDevice, ...], str]:
        """Return the connected devices, and what is missing to search for them, if anything."""
        try:
            return import_module(self.module).discover(), ""
        except DeviceError as error:
            return (), str(error)


KINDS = (
    DeviceKind("Hamamatsu cameras, over the DCAM-API", "dcam", "drivers.dcam.session"),
    DeviceKind("GigE Vision and USB3 Vision cameras, over Aravis", "genicam", "drivers.genicam.discovery"),
    DeviceKind(
        "Cameras of other makers, over Micro-Manager", "micro_manager", "drivers.micro_manager.core", "pymmcore"
    ),
    DeviceKind("Thorlabs DC2200 LED drivers, on USB", "thorlabs_dc2200", "drivers.usb_lights.thorlabs_dc2200", "pyusb"),
    DeviceKind(
        "Thorlabs DC4100 and DC4104 LED drivers, on serial ports",
        "thorlabs_dc4100",
        "drivers.serial_lights.thorlabs_dc4100",
        "pyserial",
    ),
    DeviceKind(
        "CoolLED pE-300, pE-340fura and pE-4000, on serial ports",
        "coolled",
        "drivers.serial_lights.coolled",
        "pyserial",
    ),
)
