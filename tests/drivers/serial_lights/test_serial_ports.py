"""Discovery of serial ports and of the devices they may lead to."""

from __future__ import annotations

import os

import pytest
from serial.tools.list_ports_common import ListPortInfo

from drivers.errors import Disconnected
from drivers.serial_lights import coolled, thorlabs_dc4100
from drivers.serial_lights._line import find_port


def port(device: str, *, maker: str = "", product: str = "n/a", serial_number: str = "") -> ListPortInfo:
    info = ListPortInfo(device)
    info.description = product
    if maker:
        info.manufacturer, info.serial_number, info.vid, info.pid = maker, serial_number, 0x0403, 0x6001
    return info


@pytest.fixture(autouse=True)
def _ports(monkeypatch: pytest.MonkeyPatch) -> None:
    ports = [
        port("/dev/ttyS0"),
        port("/dev/ttyUSB0", maker="FTDI", product="FT232R USB UART", serial_number="A1"),
        port("/dev/ttyUSB1", maker="Thorlabs", product="DC4104 Controller", serial_number="B2"),
        port("/dev/ttyACM0", maker="CoolLED Ltd", product="pE-4000", serial_number="C3"),
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    monkeypatch.setattr(os, "access", lambda path, _mode: path != "/dev/ttyUSB0")


def test_port_is_found_by_serial_number() -> None:
    assert find_port("B2") == "/dev/ttyUSB1"
    with pytest.raises(Disconnected, match=r"'D4'; connected are /dev/ttyS0 \(n/a\), /dev/ttyUSB0 \(FTDI, FT232R"):
        find_port("D4")


def test_missing_ports_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    with pytest.raises(Disconnected, match="none is connected"):
        find_port("A1")
    assert thorlabs_dc4100.discover() == ()


def test_discovery_lists_possible_devices() -> None:
    found = {one.settings["port"]: one for one in thorlabs_dc4100.discover()}
    assert set(found) == {"/dev/ttyUSB0", "/dev/ttyUSB1", "/dev/ttyACM0"}  # built-in ports are ignored
    assert [one.is_certain for one in found.values()] == [False, True, False]
    assert ("dialout" in found["/dev/ttyUSB0"].missing) is (os.name == "posix")  # Windows has no groups of ports
    assert not found["/dev/ttyUSB1"].missing
    assert found["/dev/ttyUSB1"].name == "thorlabs_dc4100:/dev/ttyUSB1"
    assert "Thorlabs, DC4104 Controller, USB 0403:6001, serial number B2" in found["/dev/ttyUSB1"].description
    assert [one.is_certain for one in coolled.discover()] == [False, False, True]
