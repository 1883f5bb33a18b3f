"""Serial line to a device that answers in lines of text, with resynchronisation after a fault.

The protocols do not number their answers. After a missing or garbled answer the line is out of step: a late answer
could be taken for that of the next query. So before that query, the line sends a marker, a query with a unique answer
such as the serial number, and discards everything before that answer. An unanswered marker is not sent again before the
line has been silent for one timeout.
"""

import errno
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from drivers.device import DiscoveredDevice
from drivers.errors import Busy, DeviceError, DeviceTimeout, Disconnected

if sys.platform == "win32":
    TerminalError = OSError  # the only error there
else:
    from termios import error as TerminalError  # noqa: N812 - a class in spite of its lower-case name

_SLICE_S = 0.02  # longest wait of one call of the port
_GRACE_S = 0.05  # end of the timeout, restarted if this computer stalled
_QUIET_S = 0.1  # without a byte, after which the line is silent
_WRITE_S = 1.0
_FAULTS = (OSError, TerminalError, ValueError, TypeError)  # the last three from a lost port
_LONGEST_LINE = 4096  # of garbage without a line end


@dataclass(frozen=True, slots=True)
class Wire:
    """Ports and clock: those of this computer, or of a test."""

    open_port: Callable[..., serial.Serial] = serial.Serial
    clock: Callable[[], float] = time.monotonic


@dataclass(frozen=True, slots=True)
class Dialect:
    """Line protocol of a kind of device."""

    device: str  # name in errors
    end: bytes  # of a command; answers end with a line feed, with or without carriage return
    baudrate: int = 115200
    timeout_s: float = 0.5  # for an answer


class SerialLine:
    """A serial port with a device; every fault is raised as a `DeviceError`."""

    def __init__(self, port: str, dialect: Dialect, wire: Wire) -> None:
        self._name, self._dialect, self._clock = port, dialect, wire.clock
        self._markers: dict[str, re.Pattern[str]] = {}
        self._unanswered: set[str] = set()  # markers whose answers may be late
        self._is_in_step = True
        self._is_cut = False  # the device may have received part of a command
        self._received = bytearray()
        self._port = _open(port, dialect, wire)
        try:
            self.command("")  # completes an unfinished command of another program
            self._wait_until_quiet(_QUIET_S)
        except DeviceError:
            self.close()
            raise

    @property
    def where(self) -> str:
        """The device and its port, for errors."""
        return f"the {self._dialect.device} at {self._name}"

    def mark(self, markers: Mapping[str, str]) -> None:
        """Set the queries with unique answers (regular expressions)."""
        self._markers = {question: re.compile(answer) for question, answer in markers.items()}

    def command(self, text: str) -> None:
        """Send a command without an answer."""
        data = text.encode("ascii") + self._dialect.end
        if self._is_cut:
            data = self._dialect.end + data
        self._is_cut = True
        with self._faults():
            self._port.write(data)
        self._is_cut = False

    def query(self, text: str, pattern: str = r".+") -> re.Match[str]:
        """Send a query; return the first matching line. `DeviceTimeout` without any, `DeviceError` with others."""
        return self.query_lines(text, pattern, 1)[0]

    def query_lines(self, text: str, pattern: str, count: int) -> list[re.Match[str]]:
        """Send a query and return the first `count` lines that match."""
        self._resynchronise()
        self.command(text)
        try:
            return [self._await(re.compile(pattern), f"“{text}”") for _ in range(count)]
        except DeviceError:
            self._is_in_step = False
            raise

    def close(self) -> None:
        """Release the port, in any state."""
        with suppress(*_FAULTS):
            self._port.close()

    def _resynchronise(self) -> None:
        """Discard all answers to earlier queries, also late ones."""
        with self._faults():
            if waiting := self._port.in_waiting:
                self._port.read(waiting)
        self._received.clear()
        if self._is_in_step:
            return
        fresh = [marker for marker in self._markers if marker not in self._unanswered]
        are_some_unanswered = bool(self._unanswered)
        if not fresh:
            self._wait_until_quiet(self._dialect.timeout_s)
            fresh = list(self._markers)
        if fresh:
            self._unanswered.add(fresh[0])
            self.command(fresh[0])
            self._await(self._markers[fresh[0]], f"“{fresh[0]}”")
        if are_some_unanswered:  # late answers may come now
            self._wait_until_quiet(_QUIET_S)
        self._unanswered.clear()
        self._is_in_step = True

    def _await(self, pattern: re.Pattern[str], what: str) -> re.Match[str]:
        other = ""
        for wait_s in (self._dialect.timeout_s - _GRACE_S, _GRACE_S):
            until = self._clock() + wait_s
            while (line := self._read_line(until)) is not None:
                if line and (match := pattern.fullmatch(line)):
                    return match
                other = line or other
        if other:
            raise DeviceError(f"{self.where} answered {what} with {other[:60]!r}: a bad cable, or another device?")
        raise DeviceTimeout(
            f"{self.where} did not answer {what} within {self._dialect.timeout_s:g} s; is it switched on?"
        )

    def _read_line(self, until: float) -> str | None:
        """Return the next line, or None after the time `until`."""
        while True:
            end = self._received.find(b"\n")
            if end >= 0 or len(self._received) > _LONGEST_LINE:
                end = end if end >= 0 else _LONGEST_LINE
                line = bytes(self._received[:end])
                del self._received[: end + 1]
                return line.decode("ascii", "backslashreplace").strip()
            if self._clock() >= until:
                return None
            self._receive()

    def _wait_until_quiet(self, quiet_s: float) -> None:
        """Discard input until none has come for `quiet_s`."""
        until = give_up = self._clock() + quiet_s
        give_up += 2 * self._dialect.timeout_s
        while self._clock() < min(until, give_up):
            if self._receive():
                until = self._clock() + quiet_s
        self._received.clear()

    def _receive(self) -> int:
        """Wait a short time for input; return the number of bytes."""
        with self._faults():
            came = self._port.read(max(1, self._port.in_waiting))
        self._received += came
        return len(came)

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except serial.SerialTimeoutException as error:
            self._is_in_step = False
            raise DeviceTimeout(f"{self.where} takes no commands; is it switched on?") from error
        except _FAULTS as error:
            raise Disconnected.of(self.where) from error


def _open(port: str, dialect: Dialect, wire: Wire) -> serial.Serial:
    """Open a port; on Windows pyserial gives the reason of a failure only in its text."""
    device = dialect.device
    try:
        return wire.open_port(port, baudrate=dialect.baudrate, timeout=_SLICE_S, write_timeout=_WRITE_S, exclusive=True)
    except _FAULTS as error:
        number, text = getattr(error, "errno", None), str(error)
        if number in {errno.EBUSY, errno.EAGAIN} or "PermissionError" in text:
            raise Busy(f"another program holds {port}; close it to use the {device}") from error
        if number in {errno.EACCES, errno.EPERM}:
            raise DeviceError(no_permission(port)) from error
        if number in {errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO} or "FileNotFoundError" in text:
            raise Disconnected(f"there is no {port}, so no {device}; {connected()}") from error
        raise DeviceError(f"{port} cannot be opened as a serial port for the {device}: {text}") from error


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
    """Return a device's USB serial ports, unopened: queries disturb others; certain if its text has one of `words`."""
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
