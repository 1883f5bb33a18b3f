"""Serial ports of this computer."""

import os
import sys

from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from drivers.discovery import DiscoveredDevice
from drivers.errors import Disconnected


def find_port(serial_number: str) -> str:
    """Return the port whose USB adapter has this serial number."""
    names = [port.device for port in list_ports.comports() if port.serial_number == serial_number]
    if not names:
        raise Disconnected(f"no serial port has the USB serial number {serial_number!r}; {connected()}")
    return str(names[0])


def connected() -> str:
    """List of the ports, for errors."""
    names = ", ".join(f"{port.device} ({_describe(port)})" for port in list_ports.comports())
    return f"connected are {names}" if names else "none is connected"


def no_permission(port: str) -> str:
    """Advice for opening a port without permission."""
    return (
        f"you may not open {port}: run “sudo usermod -aG dialout $USER” (the group dialout owns serial ports)"
        " and log in again"
    )


def discover(driver: str, device: str, words: tuple[str, ...]) -> tuple[DiscoveredDevice, ...]:
    """Return the USB serial ports that may lead to such a device, certain if the adapter's text has one of `words`.

    Opens nothing, because a query could disturb another device.
    """
    devices = []
    for port in list_ports.comports():
        if port.vid is None:  # built in, or a pseudo-terminal
            continue
        is_certain = any(word in _describe(port).lower() for word in words)
        is_allowed = sys.platform == "win32" or os.access(port.device, os.R_OK | os.W_OK)
        devices.append(
            DiscoveredDevice(
                kind="light",
                driver=driver,
                description=f"{device} on {_describe(port)}",
                settings={"port": str(port.device)},
                is_certain=is_certain,
                missing="" if is_allowed else no_permission(str(port.device)),
            )
        )
    return tuple(devices)


def _describe(port: ListPortInfo) -> str:
    maker = port.manufacturer if port.manufacturer and port.manufacturer not in (port.description or "") else ""
    numbers = f"USB {port.vid:04x}:{port.pid:04x}" if port.vid is not None else ""
    serial_number = f"serial number {port.serial_number}" if port.serial_number else ""
    return ", ".join(filter(None, [maker, port.description, numbers, serial_number]))
