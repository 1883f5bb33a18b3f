"""CoolLED driver, byte by byte, over its stand-in in memory and on a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any, Literal

import pytest
from hypothesis.stateful import rule
from support.light_contract import LightFaultContract
from support.serial_stand_in import PtyFaults, ScriptedPort, SerialLightContract, SerialStorm, wire_to
from support.stand_ins.coolled import CoolLEDWire
from support.stand_ins.serial import FaultKind, LineFault
from support.storm import storm_settings

from drivers.errors import BadValue, DeviceError, DeviceTimeout, Disconnected, Unsupported
from drivers.serial_lights import CoolLEDSettings
from drivers.serial_lights._line import Wire
from drivers.serial_lights.coolled import CoolLED
from reconstruction.annotated_settings import check
from simulated_devices.clock import ManualClock


@pytest.fixture(params=["nothing", "command", "channel", "state"])
def device(request: pytest.FixtureRequest) -> CoolLEDWire:
    return CoolLEDWire(echo=request.param)


def open_light(device: CoolLEDWire, clock: ManualClock, **settings: Any) -> CoolLED:
    chosen = CoolLEDSettings(**{"port": "COM7", "full_current_a": 0.5, **settings})
    return CoolLED(chosen, wire=wire_to(device, clock), sleep=clock.sleep)


@pytest.fixture
def reopen(device: CoolLEDWire, clock: ManualClock) -> Callable[[], CoolLED]:
    return lambda: open_light(device, clock)


class TestContract(SerialLightContract):
    """In memory."""


@pytest.mark.posix
class TestContractOnAPort(LightFaultContract):
    @pytest.fixture
    def faults(self) -> Iterator[PtyFaults]:
        faults = PtyFaults(CoolLEDWire("pE-300"))
        yield faults
        faults.server.close()

    @pytest.fixture
    def reopen(self, faults: PtyFaults) -> Callable[[], CoolLED]:
        return lambda: CoolLED(CoolLEDSettings(port=faults.server.port, channel="C"), wire=faults.wire)


OPENING = [
    (b"\r", b"CoolLED pE-4000\r\nSystem ready\r\n"),
    (b"XMODEL\r", b"XMODEL:pE-4000\r\n"),
    (b"CSF\r", b""),
    (b"CSS?\r", b"CSSASF020BSF020CSF020DSF100\n"),  # a line feed alone ends a line
    (b"CSS?\r", b"CSSASF020BSF020CSF020DSF100\r\n"),
    (b"LAMS\r", b"LAM:A:365\r\nLAM:B:470\r\nLAM:C:525\r\nLAM:D:635\r\n"),
    (b"LOAD:460\r", b"LAM:B:460\r\n"),
    (b"LAMS\r", b"LAM:A:365\r\nLAM:B:460\r\nLAM:C:525\r\nLAM:D:635\r\n"),
    (b"CSF\r", b""),
    (b"CSS?\r", b"CSSASF020BSF020CSF020DSF100\r\n"),
    (b"CSS?\r", b"CSSASF020BSF020CSF020DSF100\r\n"),
]
SWITCHING_ON = [
    (b"CSS?\r", b"CSSASF020BSF020CSF020DSF100\r\n"),  # is it on?
    (b"CSS?\r", b"CSSASF020BSF020CSF020DSF100\r\n"),  # at which current?
    (b"CBI0\r", b"CBSF000\r\n"),
    (b"CSS?\r", b"CSSASF020BSF000CSF020DSF100\r\n"),
    (b"CSS?\r", b"CSSASF020BSF000CSF020DSF100\r\n"),  # which channels are there?
    (b"CAX\r", b""),
    (b"CSS?\r", b"CSSAXF020BSF000CSF020DSF100\r\n"),
    (b"CBS\r", b""),
    (b"CSS?\r", b"CSSAXF020BSF000CSF020DSF100\r\n"),
    (b"CCX\r", b""),
    (b"CSS?\r", b"CSSAXF020BSF000CXF020DSF100\r\n"),
    (b"CDX\r", b""),
    (b"CSS?\r", b"CSSAXF020BSF000CXF020DXF100\r\n"),
    (b"CSN\r", b""),
    (b"CSS?\r", b"CSSAXF020BSN000CXF020DXF100\r\n"),
    (b"CSS?\r", b"CSSAXF020BSN000CXF020DXF100\r\n"),  # where the ramp begins
    (b"CBI10\r", b"CBSN010\r\n"),
    (b"CSS?\r", b"CSSAXF020BSN010CXF020DXF100\r\n"),
    (b"CSS?\r", b"CSSAXF020BSN010CXF020DXF100\r\n"),  # is it still on?
    (b"CBI20\r", b"CBSN020\r\n"),
    (b"CSS?\r", b"CSSAXF020BSN020CXF020DXF100\r\n"),
    (b"CSS?\r", b"CSSAXF020BSN020CXF020DXF100\r\n"),
]
CLOSING = [(b"CSF\r", b""), (b"CSS?\r", b"CSSAXF020BSF020CXF020DXF100\r\n")]


def test_bytes_from_opening_to_closing_match_protocol(clock: ManualClock) -> None:
    port, seen = ScriptedPort(OPENING + SWITCHING_ON + CLOSING, clock), dict[str, Any]()
    settings = CoolLEDSettings(port="COM7", channel="B", full_current_a=0.5, wavelength_nm=460)
    light = CoolLED(settings, wire=Wire(open_port=port.opener(seen), clock=clock.now), sleep=clock.sleep)
    assert seen["baudrate"] == 57600
    assert light.name == "CoolLED pE-4000 channel B"
    light.set_on(True)
    light.close()
    assert port.is_done()


def test_percent_translates_to_current(device: CoolLEDWire, light: CoolLED) -> None:
    assert light.current_range_a.maximum == 0.5
    assert light.set_current(0.25) == 0.25
    assert device.lamps["A"].percent == 50
    assert light.set_current(0.0199) == 0.015  # whole percents, never above the request
    assert device.lamps["A"].percent == 3
    assert light.set_current(0.145) == 0.145  # 29 %, not 28 by truncation


def test_opening_switches_off_and_selects_one_channel(device: CoolLEDWire, light: CoolLED) -> None:
    assert not device.is_lit
    light.set_on(True)
    assert {letter for letter, lamp in device.lamps.items() if lamp.is_on} == {"A"}


def test_turned_knob_changes_current(device: CoolLEDWire, light: CoolLED) -> None:
    light.set_on(True)
    device.turn_knob("A", 70)
    assert light.current_a == 0.35
    assert light.is_on
    device.lamps["A"].is_on = False
    with pytest.raises(DeviceError, match="at its pod"):
        _ = light.is_on


def test_configured_wavelength_is_loaded_into_channel(device: CoolLEDWire, clock: ManualClock) -> None:
    with open_light(device, clock, channel="B", wavelength_nm=490) as light:
        assert device.lamps["B"].wavelength_nm == 490
        assert light.properties()["wavelength_nm"] == 490
    with pytest.raises(BadValue, match="does not load 385 nm into channel B: A has 385 nm, B has 490 nm"):
        open_light(device, clock, channel="B", wavelength_nm=385)


@pytest.mark.parametrize("channel", "EFGH")
def test_no_wavelength_is_loaded_into_expansion_box(channel: Literal["E", "F", "G", "H"]) -> None:
    with pytest.raises(ValueError, match="into channels A to D only: leave it out for the expansion box"):
        check(CoolLEDSettings(port="COM7", channel=channel, wavelength_nm=460))


@pytest.mark.parametrize("channel", ["D", "E", "H"])
def test_channels_of_expansion_box_are_used(clock: ManualClock, channel: str) -> None:
    device = CoolLEDWire(has_expansion_box=True)
    with open_light(device, clock, channel=channel) as light:
        light.set_current(0.25)
        light.set_on(True)
        assert {letter for letter, lamp in device.lamps.items() if lamp.is_on} == {channel}
        assert device.lamps[channel].percent == 50
        assert ("wavelength_nm" in light.properties()) == (channel == "D")
    assert not device.is_lit


def test_pe_340_opens(clock: ManualClock) -> None:
    device = CoolLEDWire("pE-340fura")
    with open_light(device, clock) as light:
        assert light.name == "CoolLED pE-340 channel A"
    with pytest.raises(Unsupported, match="leave wavelength_nm out for a pE-340"):
        open_light(device, clock, wavelength_nm=380)


def test_pe_300_opens_channels_without_wavelengths(clock: ManualClock) -> None:
    device = CoolLEDWire("pE-300")
    with open_light(device, clock, channel="C") as light:
        assert light.name == "CoolLED pE-300 channel C"
        assert "wavelength_nm" not in light.properties()
    with pytest.raises(BadValue, match="has the channels A, B, C, but no D"):
        open_light(device, clock, channel="D")
    with pytest.raises(Unsupported, match="only a pE-4000"):
        open_light(device, clock, wavelength_nm=460)
    assert not device.is_lit


@pytest.mark.parametrize("kind", ["silence", "late", "half", "garbage"])
def test_lost_answer_switches_off_and_next_query_works(device: CoolLEDWire, light: CoolLED, kind: FaultKind) -> None:
    light.set_current(0.2)
    light.set_on(True)
    device.faults.append(LineFault(kind, delay_s=0.6 if kind == "late" else 0.0))
    with pytest.raises(DeviceError) as caught:
        _ = light.current_a
    assert isinstance(caught.value, DeviceTimeout) == (kind != "garbage")
    assert not device.is_lit
    assert light.current_a == 0.2
    assert light.set_current(0.15) == 0.15


@pytest.mark.parametrize("delay_s", [0.51, 0.6, 0.9, 1.02, 1.3])
def test_late_answer_is_not_taken_for_later_state(device: CoolLEDWire, light: CoolLED, delay_s: float) -> None:
    light.set_current(0.2)
    device.faults.append(LineFault("late", delay_s=delay_s))
    with pytest.raises(DeviceTimeout):
        _ = light.current_a
    device.lamps["A"].percent = 80
    for _ in range(4):
        with suppress(DeviceTimeout):
            assert light.current_a == 0.4
            assert device.received.count("XMODEL") > 1  # the marker
            return
    pytest.fail("never came into step again")


def test_noise_is_ignored(device: CoolLEDWire, light: CoolLED) -> None:
    device.faults.append(LineFault("noise"))
    assert light.current_a == 0.1


def test_lost_command_is_repeated(device: CoolLEDWire, light: CoolLED, monkeypatch: pytest.MonkeyPatch) -> None:
    original, lost = device.answer, ["CAI50"]

    def answer(command: str) -> Iterable[str]:
        if command in lost:
            lost.remove(command)
            return []
        return original(command)

    monkeypatch.setattr(device, "answer", answer)
    assert light.set_current(0.25) == 0.25
    assert device.lamps["A"].percent == 50
    assert not lost


def test_light_that_stays_on_raises(device: CoolLEDWire, light: CoolLED) -> None:
    light.set_on(True)
    device.is_stuck_on = True
    with pytest.raises(DeviceError, match="still on"):
        light.set_on(False)


def test_other_instrument_is_left_alone(clock: ManualClock) -> None:
    device = CoolLEDWire("SM-7")
    with pytest.raises(DeviceError, match="another device"):
        open_light(device, clock)
    assert device.received == ["", "XMODEL"]
    assert device.is_lit  # still, whatever the driver did


def test_more_than_100_percent_raises(device: CoolLEDWire, light: CoolLED) -> None:
    device.lamps["C"].percent = 101
    with pytest.raises(DeviceError, match="more than 100 %"):
        _ = light.current_a


def test_unplugged_during_command_raises(device: CoolLEDWire, light: CoolLED, clock: ManualClock) -> None:
    device.faults.append(LineFault("unplug"))
    start_s = clock.now()
    with pytest.raises(Disconnected, match="CoolLED at COM7 is gone"):
        light.set_current(0.1)
    assert clock.now() - start_s < 2


def test_port_is_needed() -> None:
    with pytest.raises(ValueError, match="port"):
        check(CoolLEDSettings())


class Storm(SerialStorm):
    device: CoolLEDWire

    def make(self) -> CoolLEDWire:
        return CoolLEDWire()

    def open(self) -> CoolLED:
        return open_light(self.device, self.clock)

    def true_current_a(self) -> float:
        return self.device.lamps["A"].percent * 0.5 / 100

    def true_maximum_a(self) -> float:
        return 0.5

    @rule()
    def knob(self) -> None:
        self.device.turn_knob("B", 55)


TestStorm = Storm.TestCase
TestStorm.settings = storm_settings()
