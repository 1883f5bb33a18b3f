"""DC2200 driver over its stand-in on the USB bus."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import pytest
from hypothesis import strategies as st
from support.light_contract import LightFaultContract
from support.light_log import LightLog
from support.light_storm import HeatStorm
from support.stand_ins.dc2200 import DC2200Wire
from support.stand_ins.usbtmc import UsbFault, UsbFaultKind
from support.storm import storm_settings
from usb_stand_in import Bus, Plug

from drivers.errors import BadValue, Busy, DeviceError, DeviceTimeout, Disconnected, Unsupported, WrongState
from drivers.usb_lights import DC2200Settings
from drivers.usb_lights.thorlabs_dc2200 import ThorlabsDC2200, discover
from simulated_devices.clock import ManualClock


@pytest.fixture
def device() -> DC2200Wire:
    return DC2200Wire()


def open_light(device: DC2200Wire, clock: ManualClock, **settings: Any) -> ThorlabsDC2200:
    bus = Bus(Plug(device, device.serial_number), clock=clock)
    return ThorlabsDC2200(DC2200Settings(**settings), backend=bus, sleep=clock.sleep)


@pytest.fixture
def reopen(device: DC2200Wire, clock: ManualClock) -> Callable[[], ThorlabsDC2200]:
    return lambda: open_light(device, clock)


class Faults:
    def __init__(self, device: DC2200Wire) -> None:
        self.device = device

    @property
    def log(self) -> LightLog:
        return self.device.log

    def fail_next(self) -> None:
        self.device.faults.append(UsbFault("silence"))

    def refuse_next(self) -> None:
        self.device.refuses_next = True

    def unplug(self) -> None:
        self.device.is_unplugged = True

    def plug_in(self) -> None:
        self.device.plug_in()


class TestContract(LightFaultContract):
    @pytest.fixture
    def faults(self, device: DC2200Wire) -> Faults:
        return Faults(device)


class TestContractGated(TestContract):
    @pytest.fixture
    def reopen(self, device: DC2200Wire, clock: ManualClock) -> Callable[[], ThorlabsDC2200]:
        return lambda: open_light(device, clock, gate="ttl", terminal=2)


def test_commands_from_opening_to_closing_match_protocol(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    assert device.received == [
        "*IDN?",
        "OUTP 0",
        "*CLS",
        "OUTP:TERM?",
        "*CLS",
        "OUTP:TERM 1",
        "SYST:ERR?",
        "SYST:TERM1:HTYP?",  # does it know this query?
        "SYST:TERM1:HTYP?",
        "*CLS",
        "SOUR:MODE CC",
        "SYST:ERR?",
        "SOUR:CCUR:CURR?",  # and these?
        "SOUR:CURR:LIM:AMPL?",
        "SOUR:CURR:LIM:AMPL? MAX",
        "SENS3:CURR:DATA?",
        "OUTP:PROT:TEMP:DRIV:TRIP?",
        "OUTP:PROT:TEMP:HEAD:TRIP?",
        "OUTP 0",
        "SYST:ERR?",
        "OUTP?",
        "SOUR:CURR:LIM:AMPL?",
        "SOUR:CURR:LIM:AMPL? MAX",
        "SOUR:CCUR:CURR?",
    ]
    assert device.transfers[2] == b"\x01\x03\xfc\x00\x06\x00\x00\x00\x01\x00\x00\x00OUTP 0\x00\x00"
    del device.received[:]
    assert light.set_current(0.12345678) == 0.1234  # tenths of a milliampere, never above the request
    assert device.received[-4:] == ["*CLS", "SOUR:CCUR:CURR 0.1234", "SYST:ERR?", "SOUR:CCUR:CURR?"]
    del device.received[:]
    light.close()
    assert device.received == ["OUTP 0", "SYST:ERR?", "OUTP?"]


def test_opening_switches_off(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    assert not device.is_lit
    assert (device.terminal, device.mode) == (1, "CC")
    assert light.name == "Thorlabs DC2200 M00331234 terminal 1"


@pytest.mark.parametrize(
    ("terminal", "limit_a", "maximum_a"), [(1, None, 1.0), (2, None, 0.5), (2, 0.05, 0.05), (1, 5.0, 1.0)]
)
def test_lowest_of_three_limits_holds(
    device: DC2200Wire, clock: ManualClock, terminal: int, limit_a: float | None, maximum_a: float
) -> None:
    with open_light(device, clock, terminal=terminal, limit_a=limit_a) as light:
        assert light.current_range_a.maximum == maximum_a
        assert light.current_a <= maximum_a
        assert light.set_current(maximum_a) == device.current_a == maximum_a
        with pytest.raises(BadValue, match="outside 0"):
            light.set_current(maximum_a + 0.001)


def test_limit_of_another_head_is_ignored(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    terminal = device.terminals[1]
    terminal.limit_a = 2 * terminal.maximum_a
    assert light.current_range_a.maximum == terminal.maximum_a


def test_ttl_gate_sets_mode_and_current(device: DC2200Wire, clock: ManualClock) -> None:
    with open_light(device, clock, gate="ttl", terminal=2) as light:
        assert device.mode == "TTL"
        light.set_current(0.25)
        assert device.ttl_a == 0.25
        light.set_on(True)
        assert light.is_on
        assert "SOUR:TTL:CURR 0.2500" in device.received
        assert not any(command.startswith("SOUR:CCUR") for command in device.received)
        assert light.properties()["gate"] == "ttl"
    assert not device.is_output_on


def test_errors_are_queried_after_each_command(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    light.set_current(0.3)
    light.set_on(True)
    light.set_on(False)
    for command, after in zip(device.received[4:], [*device.received[5:], ""], strict=True):
        if "?" not in command and command != "*CLS":
            assert after == "SYST:ERR?"


def test_properties_describe_terminal_and_head(light: ThorlabsDC2200) -> None:
    light.set_current(0.2)
    light.set_on(True)
    assert light.properties() == {
        "name": "Thorlabs DC2200 M00331234 terminal 1",
        "is_on": True,
        "current_a": 0.2,
        "lowest_current_a": 0.0,
        "highest_current_a": 1.0,
        "firmware": "1.2.0",
        "terminal": 1,
        "gate": "internal",
        "head": "Thorlabs,M455L4,M00412345,1.0.0",
        "user_limit_a": 1.0,
        "head_maximum_a": 1.0,
        "measured_current_a": 0.2,
        "fault": "",
        "commands": "SOUR:CCUR:CURR?, SOUR:CURR:LIM:AMPL?, SOUR:CURR:LIM:AMPL? MAX, SENS3:CURR:DATA?",
        "not known to it": "",
    }


@pytest.mark.parametrize("kind", ["silence", "late", "half", "wrong tag", "garbage", "deaf", "stall"])
def test_lost_answer_switches_off_and_next_query_works(
    device: DC2200Wire, light: ThorlabsDC2200, kind: UsbFaultKind
) -> None:
    light.set_current(0.2)
    light.set_on(True)
    assert device.is_lit
    device.faults.append(UsbFault(kind))
    with pytest.raises(DeviceError) as caught:
        light.set_current(0.1)
    assert isinstance(caught.value, DeviceTimeout) == (kind in {"silence", "late", "deaf"})
    assert not device.is_lit
    assert light.current_a == 0.2
    assert light.current_range_a.maximum == 1.0
    assert light.set_current(0.15) == 0.15


def test_refused_value_is_reported(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    device.refuses_next = True
    with pytest.raises(BadValue, match=r"M00331234 refuses “SOUR:CCUR:CURR 0.1000”: Data out of range \(error -222\)"):
        light.set_current(0.1)


def test_other_value_than_requested_raises(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    light.set_on(True)

    def set_milliamperes(argument: str) -> None:
        device.current_a = float(argument) * 1000

    device._commands = [
        (pattern, set_milliamperes if pattern.fullmatch("SOUR:CCUR:CURR") else setter, getter)
        for pattern, setter, getter in device._commands
    ]
    with pytest.raises(DeviceError, match=r"set 200 A instead of 0.2 A"):
        light.set_current(0.2)
    assert not device.is_lit


def test_old_errors_are_cleared(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    for _ in range(12):
        list(device.receive("NONSENSE"))
    assert light.set_current(0.15) == 0.15


def test_over_temperature_switches_off(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    light.set_on(True)
    device.heat_up()
    with pytest.raises(DeviceError, match="head is too hot; let it cool"):
        _ = light.is_on
    assert not light.is_on
    with pytest.raises(DeviceError, match="too hot"):
        light.set_on(True)
    device.is_hot = False
    light.set_on(True)
    assert device.is_lit


def test_screen_switch_off_is_noticed(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    light.set_on(True)
    device.is_output_on = False
    with pytest.raises(DeviceError, match="at its screen"):
        light.set_current(0.1)


def test_light_that_stays_on_raises(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    light.set_on(True)
    device.is_stuck_on = True
    with pytest.raises(DeviceError, match="still on"):
        light.set_on(False)


@pytest.mark.parametrize("gate", ["internal", "ttl"])
def test_undefined_commands_have_fallbacks(device: DC2200Wire, clock: ManualClock, gate: str) -> None:
    lacking = {"SOUR:CCUR:CURR", "SOUR:TTL:CURR", "SOUR:CURR:LIM:AMPL", "SENS3:CURR:DATA"}
    device.undefined = lacking | {f"{command}?" for command in lacking}
    with open_light(device, clock, gate=gate, terminal=2) as light:
        assert light.current_range_a.maximum == 0.5
        assert light.set_current(0.25) == 0.25
        light.set_on(True)
        properties = light.properties()
        assert properties["measured_current_a"] == 0.25
        source = {"internal": "SOUR:CCUR?", "ttl": "SOUR:TTL?"}[gate]
        assert properties["commands"] == f"{source}, SOUR:CURR:LIM?, SOUR:CURR:LIM? MAX, MEAS:CURR?"
        assert light.is_on


def test_light_works_without_undefined_queries(device: DC2200Wire, clock: ManualClock) -> None:
    device.undefined = {
        *("SYST:TERM1:HTYP?", "SENS3:CURR:DATA?", "MEAS:CURR?", "OUTP:PROT:TEMP:DRIV:TRIP?"),
        *("OUTP:PROT:TEMP:HEAD:TRIP?", "SOUR:CURR:LIM:AMPL? MAX", "SOUR:CURR:LIM? MAX"),
    }
    with open_light(device, clock) as light:
        light.set_current(0.2)
        light.set_on(True)
        opened_s = clock.now()
        properties = light.properties()
        assert clock.now() == opened_s  # without a timeout
        assert device.is_lit
        assert not {"measured_current_a", "head_maximum_a"} & properties.keys()
        assert properties["head"] == "unknown"
        assert properties["not known to it"] == (
            "head, head's maximum, measured current, its driver is too hot, the LED's head is too hot"
        )
        assert light.current_range_a.maximum == 1.0


def test_device_without_current_or_limit_is_refused(device: DC2200Wire, clock: ManualClock) -> None:
    device.undefined = {"SOUR:CURR:LIM:AMPL?", "SOUR:CURR:LIM?"}
    with pytest.raises(Unsupported, match=r"M00331234 reports no current or no limit of it, as the firmware 1\.2\.0"):
        open_light(device, clock)
    assert not device.is_lit


def test_measured_noise_may_be_negative(device: DC2200Wire, light: ThorlabsDC2200) -> None:
    device.noise_a = -2e-6
    assert light.properties()["measured_current_a"] == -2e-6
    device.current_a = -0.1
    with pytest.raises(DeviceError, match=r"answered “SOUR:CCUR:CURR\?” with '-1"):
        _ = light.current_a


def test_missing_head_is_reported(device: DC2200Wire, clock: ManualClock) -> None:
    device.terminals[1].head = "Thorlabs,no head,no head,-2.0.0"
    with pytest.raises(WrongState, match="no LED at terminal 1"):
        open_light(device, clock)
    assert not device.is_lit


def test_other_instrument_is_left_alone(device: DC2200Wire, clock: ManualClock) -> None:
    device.model = "PM400"
    with pytest.raises(DeviceError, match=r"identifies itself as 'Thorlabs,PM400,.*no DC2200"):
        open_light(device, clock)
    assert device.received == ["*IDN?"]


def test_unplugged_during_command_raises(device: DC2200Wire, light: ThorlabsDC2200, clock: ManualClock) -> None:
    device.faults.append(UsbFault("unplug"))
    start_s = clock.now()
    with pytest.raises(Disconnected, match="DC2200 M00331234 is gone"):
        light.set_current(0.1)
    assert clock.now() - start_s < 2
    light.close()
    light.close()


def test_unplugged_during_opening_raises(device: DC2200Wire, clock: ManualClock) -> None:
    device.faults.append(UsbFault("unplug"))
    with pytest.raises(Disconnected):
        open_light(device, clock)
    device.plug_in()
    with open_light(device, clock) as light:
        assert not light.is_on


def test_one_of_several_must_be_named(device: DC2200Wire, clock: ManualClock) -> None:
    other = DC2200Wire("M00990000")
    bus = Bus(Plug(device, "M00331234"), Plug(other, "M00990000"), clock=clock)
    assert [(one.description, one.settings) for one in discover(bus)] == [
        ("Thorlabs DC2200 M00331234", {"serial_number": "M00331234"}),
        ("Thorlabs DC2200 M00990000", {"serial_number": "M00990000"}),
    ]
    with ThorlabsDC2200(DC2200Settings(serial_number="M00990000"), backend=bus, sleep=clock.sleep) as light:
        assert "M00990000" in light.name
    assert not device.received
    with pytest.raises(BadValue, match="2 DC2200s; say which by serial_number: M00331234, M00990000"):
        ThorlabsDC2200(DC2200Settings(), backend=bus)
    with pytest.raises(Disconnected, match="no DC2200 M1; there are M00331234, M00990000"):
        ThorlabsDC2200(DC2200Settings(serial_number="M1"), backend=bus)
    with pytest.raises(Disconnected, match="no DC2200: none answers"):
        ThorlabsDC2200(DC2200Settings(), backend=Bus(clock=clock))


def test_device_without_permission_is_reported(device: DC2200Wire, clock: ManualClock) -> None:
    plug = Plug(device, "M1")
    plug.is_allowed = False
    (found,) = discover(Bus(plug, clock=clock))
    assert found.name == "thorlabs_dc2200"
    assert "udevadm control --reload" in found.missing
    with pytest.raises(DeviceError, match=r"you may not use the USB device 1313:80c8: .*70-svwfs.rules"):
        ThorlabsDC2200(DC2200Settings(), backend=Bus(plug, clock=clock))
    plug.is_allowed, plug.is_taken = True, True
    with pytest.raises(Busy):
        ThorlabsDC2200(DC2200Settings(), backend=Bus(plug, clock=clock))


class Storm(HeatStorm):
    device: DC2200Wire

    def make(self) -> DC2200Wire:
        return DC2200Wire()

    def open(self) -> ThorlabsDC2200:
        return open_light(self.device, self.clock)

    def true_current_a(self) -> float:
        return float(f"{self.device.current_a:.6E}")

    def true_maximum_a(self) -> float:
        return self.device.terminals[1].maximum_a

    def faults(self) -> st.SearchStrategy[UsbFault]:
        return st.builds(UsbFault, st.sampled_from(get_args(UsbFaultKind)), st.integers(1, 3))

    def happen(self, fault: UsbFault) -> None:
        self.device.faults.append(fault)

    def recover(self) -> None:
        super().recover()
        self.device.plug_in()


TestStorm = Storm.TestCase
TestStorm.settings = storm_settings()
