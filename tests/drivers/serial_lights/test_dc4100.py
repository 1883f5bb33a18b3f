"""DC4100 driver, byte by byte, over its stand-in in memory."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from support.light_storm import HeatStorm
from support.serial_stand_in import ScriptedPort, SerialLightContract, SerialStorm, wire_to
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.serial import FaultKind, LineFault
from support.storm import storm_settings

from drivers.errors import BadValue, DeviceError, DeviceTimeout, Disconnected, WrongState
from drivers.serial_lights import DC4100Settings
from drivers.serial_lights._line import Wire
from drivers.serial_lights.thorlabs_dc4100 import ThorlabsDC4100, faults, is_at_limit
from reconstruction.annotated_settings import check
from simulated_devices.clock import ManualClock

# Traffic of opening channel 1, written by hand from the protocol.
OPENING = [
    (b"\r\n", b""),
    (b"n?\r\n", b"DC4104\r\n"),
    (b"o -1 0\r\n", b""),
    (b"v?\r\n", b"1.8.4\r\n"),
    (b"s?\r\n", b"M00266001\r\n"),
    (b"e?\r\n", b"ERROR 1: Unknown command\r\n"),  # an old error
    (b"sm?\r\n", b"1\r\n"),
    (b"sm 0\r\n", b""),
    (b"e?\r\n", b"ERROR 0: No error\r\n"),
    (b"m?\r\n", b"2\r\n"),
    (b"m 0\r\n", b""),
    (b"e?\r\n", b"ERROR 0: No error\r\n"),
    (b"r?\r\n", b"2560\r\n"),  # 0b1010_0000_0000: no LED at channels 2 and 3
    (b"wl? 1\r\n", b"455.0\r\n"),
    (b"hs? 1\r\n", b"M00250001\r\n"),
    (b"o -1 0\r\n", b""),
    (b"e?\r\n", b"ERROR 0: No error\r\n"),
    (b"o? 1\r\n", b"0\r\n"),
    (b"ml? 1\r\n", b"350\r\n"),
    (b"l? 1\r\n", b"200\r\n"),
    (b"cc? 1\r\n", b"900\r\n"),
    (b"cc 1 200\r\n", b""),
    (b"e?\r\n", b"ERROR 0: No error\r\n"),
    (b"cc? 1\r\n", b"200\r\n"),
]
CLOSING = [(b"o -1 0\r\n", b""), (b"e?\r\n", b"ERROR 0: No error\r\n"), (b"o? 1\r\n", b"0\r\n")]


@pytest.fixture
def device() -> DC4100Wire:
    device = DC4100Wire()
    device.heads[0].is_on = True  # left on
    return device


def open_light(device: DC4100Wire, clock: ManualClock, **settings: Any) -> ThorlabsDC4100:
    chosen = DC4100Settings(port="COM7", **settings)
    return ThorlabsDC4100(chosen, wire=wire_to(device, clock), sleep=clock.sleep)


@pytest.fixture
def reopen(device: DC4100Wire, clock: ManualClock) -> Callable[[], ThorlabsDC4100]:
    return lambda: open_light(device, clock)


class TestContract(SerialLightContract):
    """In memory."""


def test_bytes_from_opening_to_closing_match_protocol(clock: ManualClock) -> None:
    setting = [
        (b"ml? 1\r\n", b"350\r\n"),
        (b"l? 1\r\n", b"200\r\n"),
        (b"o? 1\r\n", b"0\r\n"),
        (b"cc 1 20\r\n", b""),
        (b"e?\r\n", b"ERROR 0: No error\r\n"),
        (b"cc? 1\r\n", b"20\r\n"),
    ]
    port, seen = ScriptedPort(OPENING + setting + CLOSING, clock), dict[str, Any]()
    wire = Wire(open_port=port.opener(seen), clock=clock.now)
    light = ThorlabsDC4100(DC4100Settings(port="COM7", channel=1), wire=wire, sleep=clock.sleep)
    assert light.name == "Thorlabs DC4104 M00266001 LED2"
    assert light.set_current(0.0204) == 0.020  # whole milliamperes, never above the request
    light.close()
    assert port.is_done()
    assert seen == {"port": "COM7", "baudrate": 115200, "timeout": 0.02, "write_timeout": 1.0, "exclusive": True}


def test_opening_switches_off_and_sets_constant_current(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    assert not device.is_lit
    assert (device.mode, device.selection) == (0, 0)
    light.set_on(True)
    assert [head.is_on for head in device.heads] == [True, False, False, False]


@pytest.mark.parametrize(
    ("channel", "limit_a", "maximum_a"), [(0, None, 1.0), (1, None, 0.2), (1, 0.05, 0.05), (0, 5.0, 1.0)]
)
def test_lowest_of_three_limits_holds(
    device: DC4100Wire, clock: ManualClock, channel: int, limit_a: float | None, maximum_a: float
) -> None:
    with open_light(device, clock, channel=channel, limit_a=limit_a) as light:
        assert light.current_range_a.maximum == maximum_a
        assert light.current_a <= maximum_a
        assert light.set_current(maximum_a) == maximum_a
        with pytest.raises(BadValue, match="outside 0"):
            light.set_current(maximum_a + 0.001)
        assert device.heads[channel].current_ma == round(maximum_a * 1000)


def test_owner_limit_is_not_rounded_up(device: DC4100Wire, clock: ManualClock) -> None:
    with open_light(device, clock, limit_a=0.0357) as light:
        assert light.set_current(0.0357) == 0.035


def test_current_rises_in_steps(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    light.set_current(1.0)
    del device.received[:]
    light.set_on(True)
    steps = [int(command.split()[2]) for command in device.received if command.startswith("cc ")]
    assert steps[0] == 0
    assert steps == sorted(steps)
    assert len(steps) >= 8
    assert steps[-1] == 1000


def test_errors_are_queried_after_each_command(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    light.set_current(0.1)
    light.set_on(True)
    light.set_on(False)
    for command, after in zip(device.received, [*device.received[1:], ""], strict=True):
        if command and "?" not in command and command != "o -1 0":
            assert after == "e?"


@pytest.mark.parametrize(
    ("register", "words"),
    [
        (0, ""),
        (1 << 1, "power supply"),
        (1 << 3, "too hot"),
        (1 << 9, "no LED"),  # 5, 7, 9, 11 are LED1 ... LED4
        (1 << 17, "does not conduct"),  # 13, 15, 17, 19
        (1 << 5 | 1 << 7 | 1 << 11 | 1 << 13 | 1 << 15 | 1 << 19, ""),  # the other channels
        (0x55555555, ""),  # even bits flag changes only
    ],
)
def test_status_register_is_decoded(register: int, words: str) -> None:
    fault = faults(register, 2)
    assert words in fault
    assert bool(words) == bool(fault)


def test_current_limit_is_no_fault() -> None:
    assert is_at_limit(1 << 25, 2)
    assert not is_at_limit(1 << 23, 2)
    assert not faults(1 << 25, 2)


def test_properties_describe_channel_and_head(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    assert light.properties() == {
        "name": "Thorlabs DC4100 M00266001 LED1",
        "is_on": False,
        "current_a": 0.1,
        "lowest_current_a": 0.0,
        "highest_current_a": 1.0,
        "firmware": "1.8.4",
        "channel": 0,
        "wavelength_nm": "455.0",
        "head_serial_number": "M00250001",
        "head_maximum_a": 1.0,
        "user_limit_a": 1.0,
        "is_at_limit": False,
        "fault": "",
    }
    device.heads[0].is_open = True
    assert "does not conduct" in str(light.properties()["fault"])


@pytest.mark.parametrize("kind", ["silence", "late", "half", "garbage"])
def test_lost_answer_switches_off_and_next_query_works(
    device: DC4100Wire, light: ThorlabsDC4100, kind: FaultKind
) -> None:
    light.set_current(0.2)
    light.set_on(True)
    assert device.is_lit
    device.faults.append(LineFault(kind, delay_s=0.6 if kind == "late" else 0.0))
    with pytest.raises(DeviceError) as caught:
        light.set_current(0.1)
    assert type(caught.value) is DeviceError if kind == "garbage" else isinstance(caught.value, DeviceTimeout)
    assert not device.is_lit
    assert light.current_a == 0.2
    assert light.set_current(0.15) == 0.15


@pytest.mark.parametrize("delay_s", [0.51, 0.6, 0.9, 1.02, 1.3, 1.55, 1.9])
def test_late_answer_is_not_taken_for_another(device: DC4100Wire, light: ThorlabsDC4100, delay_s: float) -> None:
    device.heads[0].current_ma = 77  # would become the limit if taken for the next answer
    device.faults.append(LineFault("late", delay_s=delay_s))
    with pytest.raises(DeviceTimeout):
        _ = light.current_a
    for _ in range(4):
        with suppress(DeviceTimeout):
            assert light.current_range_a.maximum == 1.0
            break
    else:
        pytest.fail("never came into step again")
    assert light.current_a == 0.077
    assert not light.is_on


def test_noise_between_answers_is_ignored(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    device.faults.append(LineFault("noise"))
    assert light.current_a == 0.1


def test_lost_command_is_noticed(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    light.set_current(0.2)
    light.set_on(True)
    original = device.answer

    def lose_sets(command: str) -> Any:
        return [] if command.startswith("cc 0") else original(command)

    device.answer = lose_sets  # type: ignore[method-assign] # injected fault
    with pytest.raises(DeviceError, match="set 200 mA instead of 100 mA"):
        light.set_current(0.1)
    assert not device.is_lit


def test_lost_switch_off_is_repeated(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    light.set_on(True)
    device.faults.append(LineFault("deaf"))
    light.set_on(False)
    assert not device.is_lit


def test_refused_value_is_reported(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    device.refuses_next = True
    with pytest.raises(BadValue, match=r"refuses “cc 0 100”: Value refused \(error 2\)"):
        light.set_current(0.1)


def test_over_temperature_switches_off(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    light.set_on(True)
    device.heat_up()
    with pytest.raises(DeviceError, match="too hot"):
        _ = light.is_on
    assert not light.is_on  # raised once
    with pytest.raises(DeviceError, match="too hot"):
        light.set_on(True)
    device.is_hot = False
    light.set_on(True)
    assert device.is_lit


def test_open_led_is_reported(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    device.heads[0].is_open = True
    with pytest.raises(DeviceError, match="does not conduct"):
        light.set_on(True)
    assert not device.heads[0].is_on


def test_front_panel_switch_off_is_noticed(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    light.set_on(True)
    device.heads[0].is_on = False
    with pytest.raises(DeviceError, match="front panel"):
        light.set_current(0.05)


def test_missing_head_is_reported(device: DC4100Wire, clock: ManualClock) -> None:
    with pytest.raises(WrongState, match=r"COM7, LED3: there is no LED"):
        open_light(device, clock, channel=2)
    assert not device.is_lit


def test_light_that_stays_on_raises(device: DC4100Wire, light: ThorlabsDC4100) -> None:
    light.set_on(True)
    device.is_stuck_on = True
    with pytest.raises(DeviceError, match="still on"):
        light.set_on(False)


@pytest.mark.parametrize("model", ["DC4100", "DC4104", "LEDD4"])
def test_each_model_is_recognised(clock: ManualClock, model: str) -> None:
    with open_light(DC4100Wire(f"Thorlabs {model} 1.8"), clock) as light:
        assert light.name == f"Thorlabs {model} M00266001 LED1"


@pytest.mark.parametrize("name", ["PM100D 1.0", "DC2100"])
def test_other_instrument_is_left_alone(clock: ManualClock, name: str) -> None:
    device = DC4100Wire(name)
    with pytest.raises(DeviceError, match=f"answered “n\\?” with '{name}': a bad cable, or another device"):
        open_light(device, clock)
    assert device.received == ["", "n?"]


def test_silent_port_times_out(device: DC4100Wire, clock: ManualClock) -> None:
    device.faults.append(LineFault("silence"))
    with pytest.raises(DeviceTimeout, match=r"did not answer “n\?” within 0.5 s; is it switched on"):
        open_light(device, clock)


def test_empty_line_may_be_an_error(clock: ManualClock) -> None:
    with open_light(DC4100Wire(is_empty_line_an_error=True), clock) as light:
        assert light.set_current(0.1) == 0.1


def test_unplugged_during_command_raises(device: DC4100Wire, light: ThorlabsDC4100, clock: ManualClock) -> None:
    device.faults.append(LineFault("unplug"))
    start_s = clock.now()
    with pytest.raises(Disconnected, match="COM7 is gone"):
        light.set_current(0.1)
    assert clock.now() - start_s < 2
    with pytest.raises(Disconnected):
        light.set_on(True)
    light.close()
    light.close()


@pytest.mark.parametrize(
    ("wrong", "words"), [({}, "port must be given"), ({"port": "COM1", "serial_number": "A"}, "not both")]
)
def test_invalid_settings_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check(DC4100Settings(**wrong))


class Storm(SerialStorm, HeatStorm):
    device: DC4100Wire

    def make(self) -> DC4100Wire:
        return DC4100Wire()

    def open(self) -> ThorlabsDC4100:
        return open_light(self.device, self.clock)

    def true_current_a(self) -> float:
        return self.device.heads[0].current_ma / 1000

    def true_maximum_a(self) -> float:
        return self.device.heads[0].maximum_ma / 1000


TestStorm = Storm.TestCase
TestStorm.settings = storm_settings()
