"""What is connected, what could be, and what is missing to use it. Nothing is switched on by looking."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

from drivers.discovery import DiscoveredDevice
from drivers.errors import DeviceError


@dataclass(frozen=True, slots=True)
class Search:
    """A kind of devices that is supported, and what looks for it."""

    what: str
    driver: str  # as a bench names it
    module: str  # whose `discover` looks; loaded when it is asked


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a search."""

    search: Search
    found: tuple[DiscoveredDevice, ...] = ()
    missing: str = ""  # why it could not be looked for


SEARCHES = (
    Search("Hamamatsu cameras, over the DCAM-API", "dcam", "drivers.dcam.session"),
    Search("GigE Vision and USB3 Vision cameras, over Aravis", "genicam", "drivers.genicam.discovery"),
    Search("Thorlabs DC2200 LED drivers, on USB", "thorlabs_dc2200", "drivers.usb_lights.thorlabs_dc2200"),
    Search(
        "Thorlabs DC4100 and DC4104 LED drivers, on serial ports",
        "thorlabs_dc4100",
        "drivers.serial_lights.thorlabs_dc4100",
    ),
    Search("CoolLED pE-300 and pE-4000, on serial ports", "coolled", "drivers.serial_lights.coolled"),
)


def look(search: Search) -> Outcome:
    """Look for the devices of one kind."""
    try:
        return Outcome(search, import_module(search.module).discover())
    except DeviceError as error:
        return Outcome(search, missing=str(error))
