"""The serial ports of this computer: which there are, which one a bench means, and what may hang on them."""

from __future__ import annotations

import os
import sys

from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from drivers.discovery import DiscoveredDevice
from drivers.errors import Disconnected


def find_port(serial_number: str) -> str:
    """Return the name of the port whose USB adapter has that serial number."""
    names = [port.device for port in list_ports.comports() if port.serial_number == serial_number]
    if not names:
        raise Disconnected(f"no serial port has the USB serial number {serial_number!r}; {connected()}")
    return str(names[0])


def connected() -> str:
    """Say which ports there are, for errors."""
    names = ", ".join(f"{port.device} ({_describe(port)})" for port in list_ports.comports())
    return f"connected are {names}" if names else "none is connected"


def no_permission(port: str) -> str:
    """Say what it takes to be allowed to open a port."""
    return (
        f"you may not open {port}: run “sudo usermod -aG dialout $USER” (the group dialout owns serial ports)"
        " and log in again"
    )


def discover(driver: str, device: str, words: tuple[str, ...]) -> tuple[DiscoveredDevice, ...]:
    """Return the ports on USB where a device of that kind may be, certain where its adapter has one of those words.

    Nothing is opened: a serial port cannot be asked what hangs on it without speaking to whatever that is.
    """
    found = []
    for port in list_ports.comports():
        if port.vid is None:  # built in, or a pseudo-terminal
            continue
        is_certain = any(word in _describe(port).lower() for word in words)
        is_allowed = sys.platform == "win32" or os.access(port.device, os.R_OK | os.W_OK)
        found.append(
            DiscoveredDevice(
                kind="light",
                driver=driver,
                description=f"{device} on {_describe(port)}",
                settings={"port": str(port.device)},
                is_certain=is_certain,
                missing="" if is_allowed else no_permission(str(port.device)),
            )
        )
    return tuple(found)


def _describe(port: ListPortInfo) -> str:
    maker = port.manufacturer if port.manufacturer and port.manufacturer not in (port.description or "") else ""
    numbers = f"USB {port.vid:04x}:{port.pid:04x}" if port.vid is not None else ""
    serial_number = f"serial number {port.serial_number}" if port.serial_number else ""
    return ", ".join(filter(None, [maker, port.description, numbers, serial_number]))
