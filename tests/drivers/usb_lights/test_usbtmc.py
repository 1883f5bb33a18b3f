"""USBTMC, byte by byte: framing, long answers, recovery after faults."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from importlib.machinery import ModuleSpec
from types import ModuleType

import pytest
import usb.backend.libusb0
import usb.backend.libusb1
import usb.backend.openusb
from support.stand_ins.usbtmc import UsbFault, UsbFaultKind, UsbtmcWire
from usb_stand_in import IN, Bus, Plug

from drivers.errors import Busy, DeviceError, DeviceTimeout, Disconnected, Unsupported
from drivers.usb_lights import _usbtmc as usbtmc
from drivers.usb_lights._usbtmc import Usbtmc
from simulated_devices.clock import ManualClock


class Echo(UsbtmcWire):
    """Answers every query with its own text."""

    def __init__(self, *, largest_answer: int = 1 << 16) -> None:
        super().__init__(largest_answer=largest_answer)
        self.messages: list[str] = []
        self.interruptions = 0

    def receive(self, message: str) -> Iterable[str]:
        self.messages.append(message)
        return [message] if message.endswith("?") else []

    def interrupted(self) -> None:
        self.interruptions += 1


@pytest.fixture
def wire() -> Echo:
    return Echo()


def connect(wire: UsbtmcWire, clock: ManualClock) -> Usbtmc:
    (instrument,) = usbtmc.instruments(0x1313, {0x80C8}, Bus(Plug(wire, "M1"), clock=clock))
    return Usbtmc(instrument, what="the echo", sleep=clock.sleep)


def test_query_bytes_match_specification(wire: Echo, clock: ManualClock) -> None:
    echo = connect(wire, clock)
    # capabilities, remote control, clear, pending, cleared
    assert wire.requests == [(7, 0, 0), (160, 1, 0), (5, 0, 0), (6, 0, 0), (6, 0, 0)]
    assert not wire.transfers
    assert echo.query("*IDN?") == "*IDN?"
    assert wire.transfers == [
        b"\x01\x01\xfe\x00\x05\x00\x00\x00\x01\x00\x00\x00*IDN?\x00\x00\x00",
        b"\x02\x02\xfd\x00\xf4\x0f\x00\x00\x00\x00\x00\x00",  # 4084 bytes and a header make 64 packets
    ]
    echo.write("OUTP 0 ")
    assert wire.transfers[2] == b"\x01\x03\xfc\x00\x07\x00\x00\x00\x01\x00\x00\x00OUTP 0 \x00"


def test_instrument_without_remote_control_is_not_asked_for_it(wire: Echo, clock: ManualClock) -> None:
    wire.can_remote = False
    echo = connect(wire, clock)
    assert echo.query("*IDN?") == "*IDN?"
    assert not wire.is_remote
    echo.close()
    assert not {160, 161} & {request for request, _, _ in wire.requests}
    wire.can_remote = True
    connect(wire, clock)
    assert wire.is_remote


@pytest.mark.parametrize("refuses_local", [False, True])
def test_closing_gives_the_front_panel_back(wire: Echo, clock: ManualClock, *, refuses_local: bool) -> None:
    wire.refuses_local = refuses_local
    echo = connect(wire, clock)
    assert wire.is_remote
    echo.close()
    assert not wire.is_remote
    assert not wire.is_remote_enabled
    assert wire.requests[-2:] == [(161, 0, 0), (160, 0, 0)]  # go to local, remote disabled
    asked = len(wire.requests)
    echo.close()
    assert len(wire.requests) == asked


def test_closing_an_unplugged_instrument_raises_nothing(wire: Echo, clock: ManualClock) -> None:
    echo = connect(wire, clock)
    wire.is_unplugged = True
    echo.close()


@pytest.mark.parametrize("missed", [1, 2, 3])
def test_missed_opening_is_repeated_twice(wire: Echo, clock: ManualClock, missed: int) -> None:
    wire.missed_openings = missed
    if missed < 3:
        assert connect(wire, clock).query("*IDN?") == "*IDN?"
    else:
        with pytest.raises(DeviceTimeout):
            connect(wire, clock)


def test_kernel_driver_is_given_back(wire: Echo, clock: ManualClock) -> None:
    plug = Plug(wire, "M1")
    for had_driver in (True, False, True):
        plug.has_kernel_driver = had_driver
        (instrument,) = usbtmc.instruments(0x1313, {0x80C8}, Bus(plug, clock=clock))
        echo = Usbtmc(instrument, what="the echo", sleep=clock.sleep)
        assert not plug.has_kernel_driver
        echo.close()
        assert plug.has_kernel_driver == had_driver
        echo.close()


def test_tags_wrap_around_and_skip_zero(wire: Echo, clock: ManualClock) -> None:
    echo = connect(wire, clock)
    for _ in range(300):
        assert echo.query("A?") == "A?"
    tags = [transfer[1] for transfer in wire.transfers]
    assert tags == [1 + number % 255 for number in range(600)]


@pytest.mark.parametrize("length", [1, 2, 3, 4, 50, 51, 52, 53, 115, 116, 4084, 4085, 9000])
@pytest.mark.parametrize("largest_answer", [40, 52, 1 << 16])
def test_messages_of_any_length_pass(length: int, largest_answer: int, clock: ManualClock) -> None:
    wire = Echo(largest_answer=largest_answer)
    echo, question = connect(wire, clock), "x" * (length - 1) + "?"
    assert echo.query(question) == question
    assert echo.query("?") == "?"
    assert not wire.interruptions
    assert all(len(transfer) % 4 == 0 and len(transfer) <= 4096 for transfer in wire.transfers)


def test_endless_answer_is_refused(clock: ManualClock) -> None:
    with pytest.raises(DeviceError, match="endless"):
        connect(Echo(), clock).query("x" * ((1 << 20) + 1) + "?")


@pytest.mark.parametrize("kind", ["silence", "late", "half", "wrong tag", "garbage", "deaf", "stall"])
@pytest.mark.parametrize("after", [1, 2])
def test_next_query_works_after_fault(kind: UsbFaultKind, after: int, wire: Echo, clock: ManualClock) -> None:
    echo = connect(wire, clock)
    for number in range(3):
        if kind == "garbage":
            wire.faults.append(UsbFault(kind))
            assert echo.query("first?") == "\\xff\x00{"
        else:
            wire.faults.append(UsbFault(kind, after))
            with pytest.raises(DeviceError) as caught:
                echo.query("first?")
            assert isinstance(caught.value, DeviceTimeout) == (kind in {"silence", "late", "deaf"})
        assert echo.query(f"second{number}?") == f"second{number}?"
    assert not wire.faults


def test_timeout_aborts_drains_and_clears(wire: Echo, clock: ManualClock) -> None:
    echo = connect(wire, clock)
    wire.faults.append(UsbFault("silence"))
    del wire.requests[:]
    with pytest.raises(DeviceTimeout):
        echo.query("A?")
    assert wire.requests == [(3, 2, IN), (4, 0, IN), (5, 0, 0), (6, 0, 0), (6, 0, 0)]
    assert clock.now() == pytest.approx(3.0, abs=0.01)


def test_refused_message_is_aborted(wire: Echo, clock: ManualClock) -> None:
    echo = connect(wire, clock)
    echo.query("A?")
    wire.faults.append(UsbFault("deaf"))
    del wire.requests[:]
    with pytest.raises(DeviceTimeout):
        echo.write("B")
    assert wire.requests[:2] == [(1, 3, 1), (5, 0, 0)]  # not begun yet
    echo.write("C")
    assert wire.messages == ["A?", "C"]


def test_unplugged_raises_disconnected(wire: Echo, clock: ManualClock) -> None:
    echo = connect(wire, clock)
    wire.faults.append(UsbFault("unplug"))
    with pytest.raises(Disconnected, match="the echo is gone"):
        echo.query("A?")
    for call in (echo.clear, echo.read, lambda: echo.write("B")):
        with pytest.raises(Disconnected):
            call()
    echo.close()
    echo.close()


def test_unplugged_during_recovery_raises(wire: Echo, clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    echo = connect(wire, clock)
    wire.faults.append(UsbFault("silence"))
    monkeypatch.setattr(wire, "_let_time_pass", lambda: setattr(wire, "is_unplugged", True))
    with pytest.raises(Disconnected):
        echo.query("A?")


def test_unusable_instrument_states_reason(wire: Echo, clock: ManualClock) -> None:
    plug = Plug(wire, "M1")
    bus = Bus(plug, clock=clock)
    plug.is_taken = True
    (instrument,) = usbtmc.instruments(0x1313, {0x80C8}, bus)
    with pytest.raises(Busy, match="another program holds the echo"):
        Usbtmc(instrument, what="the echo")
    plug.is_taken, plug.is_allowed = False, False
    (instrument,) = usbtmc.instruments(0x1313, {0x80C8}, bus)
    assert "1313:80c8" in instrument.problem
    assert "70-svwfs.rules" in instrument.problem
    assert 'ATTR{idVendor}=="1313"' in instrument.problem
    with pytest.raises(DeviceError, match="you may not use the echo"):
        Usbtmc(instrument, what="the echo")
    plug.is_allowed, plug.has_driver = True, False
    (instrument,) = usbtmc.instruments(0x1313, {0x80C8}, bus)
    with pytest.raises(Unsupported, match="Zadig"):
        Usbtmc(instrument, what="the echo")
    plug.has_driver, plug.is_configured = True, False
    (instrument,) = usbtmc.instruments(0x1313, {0x80C8}, bus)
    assert instrument.serial_number == "M1"
    Usbtmc(instrument, what="the echo", sleep=clock.sleep).close()
    assert plug.is_configured


def test_instrument_in_update_mode_is_unsupported(wire: Echo, clock: ManualClock) -> None:
    (instrument,) = usbtmc.instruments(0x1313, {0x80C0}, Bus(Plug(wire, "M1", product_id=0x80C0), clock=clock))
    with pytest.raises(Unsupported, match="firmware update mode"):
        Usbtmc(instrument, what="the echo")


def test_missing_libusb_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for backend in (usb.backend.libusb1, usb.backend.openusb, usb.backend.libusb0):
        monkeypatch.setattr(backend, "get_backend", lambda **_: None)
    with pytest.raises(Unsupported, match=r"apt install libusb-1\.0-0"):
        usbtmc.instruments(0x1313, {0x80C8})


def test_libusb_comes_from_the_extra_where_the_system_has_none(
    wire: Echo, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = ModuleType("libusb_package")
    package.__spec__ = ModuleSpec("libusb_package", None)
    vars(package)["find_library"] = str.upper
    monkeypatch.setitem(sys.modules, "libusb_package", package)
    bus = Bus(Plug(wire, "M1"), clock=clock)

    def get_backend(find_library: Callable[[str], str] | None = None) -> Bus | None:
        return bus if find_library is not None and find_library("usb-1.0") == "USB-1.0" else None

    monkeypatch.setattr(usb.backend.libusb1, "get_backend", get_backend)
    assert [each.serial_number for each in usbtmc.instruments(0x1313, {0x80C8})] == ["M1"]


def test_listing_instruments_sends_nothing(wire: Echo, clock: ManualClock) -> None:
    assert usbtmc.instruments(0x1313, {0x80C8}, Bus(clock=clock)) == []
    assert usbtmc.instruments(0x1313, {0x1111}, Bus(Plug(wire, "M1"), clock=clock)) == []
    usbtmc.instruments(0x1313, {0x80C8}, Bus(Plug(wire, "M1"), clock=clock))
    assert not wire.requests
    assert not wire.transfers
