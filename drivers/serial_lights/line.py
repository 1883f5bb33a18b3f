"""A device on a serial port that is asked in lines of text: open, command, query, and back in step after a fault.

The protocols served here carry no numbers that say which answer belongs to which question. So after a question that
was not answered in time, or was answered by garbage, the line is out of step: an answer may yet come, and must not be
taken for that of the next question. Before that one is asked, the line asks for something with an answer that can be
known among all others (a marker, the device's name or serial number) and throws away all that comes before it. A
marker that is not answered itself is not asked again before the line has been silent for as long as an answer may take.
"""

from __future__ import annotations

import errno
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Protocol

import serial

from drivers.errors import Busy, DeviceError, DeviceTimeout, Disconnected
from drivers.serial_lights.ports import connected, no_permission

try:
    from termios import error as TerminalError  # noqa: N812 - a class, whatever its module calls it
except ImportError:  # Windows
    TerminalError = OSError  # type: ignore[misc, assignment] # nothing else is raised there

_SLICE_S = 0.02  # the longest that one call of the port may wait
_LAST_LOOK_S = 0.05  # of the time for an answer, anew where this computer stood still meanwhile
_QUIET_S = 0.1  # a pause as long as this between answers is silence
_WRITE_S = 1.0
_FAULTS = (OSError, TerminalError, ValueError, TypeError)  # pyserial's own are among OSError; a port that is gone
_LONGEST_LINE = 4096  # of garbage without an end


class Port(Protocol):
    """What is needed of a `serial.Serial`."""

    @property
    def in_waiting(self) -> int:
        """How many bytes have come."""

    def read(self, size: int, /) -> bytes:
        """Wait a short time for at least one byte."""

    def write(self, data: bytes, /) -> int | None:
        """Send."""

    def close(self) -> None:
        """Let go."""


OpenPort = Callable[..., Port]


@dataclass(frozen=True, slots=True)
class Wire:
    """What the line runs over: the ports of this computer, or a test's."""

    open_port: OpenPort = serial.Serial
    clock: Callable[[], float] = time.monotonic


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a kind of device talks."""

    device: str  # what it is called in errors
    end: bytes  # of a command; answers end with a line feed, with or without carriage return
    baudrate: int = 115200
    timeout_s: float = 0.5  # for an answer


class SerialLine:
    """A serial port with a device that answers in lines; every fault leaves it as a `DeviceError`."""

    def __init__(self, port: str, dialect: Dialect, wire: Wire) -> None:
        self._name, self._dialect, self._clock = port, dialect, wire.clock
        self._markers: dict[str, re.Pattern[str]] = {}
        self._unanswered: set[str] = set()  # markers that may yet be answered
        self._is_in_step = True
        self._is_cut = False  # the device may hold a part of a command
        self._received = bytearray()
        self._port = _open(port, dialect, wire)
        try:
            self._send("")  # ends what another program may have left unfinished
            self._wait_until_quiet(_QUIET_S)
        except DeviceError:
            self.close()
            raise

    @property
    def where(self) -> str:
        """The device and its port, for errors."""
        return f"the {self._dialect.device} at {self._name}"

    def mark(self, markers: Mapping[str, str]) -> None:
        """Say which questions have an answer (a regular expression) that no other question has."""
        self._markers = {question: re.compile(answer) for question, answer in markers.items()}

    def command(self, text: str) -> None:
        """Send what is not answered."""
        self._send(text)

    def query(self, text: str, pattern: str = r".+") -> re.Match[str]:
        """Ask, and return the first line that matches as a whole; an empty line never does.

        Raise `DeviceTimeout` when nothing came in time, `DeviceError` when only other lines came.
        """
        return self.query_lines(text, pattern, 1)[0]

    def query_lines(self, text: str, pattern: str, count: int) -> list[re.Match[str]]:
        """Ask, and return the first lines that match."""
        self._come_into_step()
        self._send(text)
        try:
            return [self._await(re.compile(pattern), f"“{text}”") for _ in range(count)]
        except DeviceError:
            self._is_in_step = False
            raise

    def close(self) -> None:
        """Let go of the port, in whatever state it is."""
        with suppress(*_FAULTS):
            self._port.close()

    def _come_into_step(self) -> None:
        """Throw away all answers to earlier questions, those that have come and those that are under way."""
        self._throw_away()
        if self._is_in_step:
            return
        fresh = [question for question in self._markers if question not in self._unanswered]
        are_some_unanswered = bool(self._unanswered)
        if not fresh:
            self._wait_until_quiet(self._dialect.timeout_s)
            fresh = list(self._markers)
        if fresh:
            self._unanswered.add(fresh[0])
            self._send(fresh[0])
            self._await(self._markers[fresh[0]], f"“{fresh[0]}”")
        if are_some_unanswered:  # they may come now
            self._wait_until_quiet(_QUIET_S)
        self._unanswered.clear()
        self._is_in_step = True

    def _await(self, pattern: re.Pattern[str], what: str) -> re.Match[str]:
        other = ""
        for patience_s in (self._dialect.timeout_s - _LAST_LOOK_S, _LAST_LOOK_S):
            until = self._clock() + patience_s
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
        """Return the next line, or None when the time is over."""
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
        """Throw away what comes until nothing has come for that time."""
        until = give_up = self._clock() + quiet_s
        give_up += 2 * self._dialect.timeout_s
        while self._clock() < min(until, give_up):
            if self._receive():
                until = self._clock() + quiet_s
        self._received.clear()

    def _receive(self) -> int:
        """Wait a short time for what comes; return the number of bytes."""
        with self._faults():
            came = self._port.read(max(1, self._port.in_waiting))
        self._received += came
        return len(came)

    def _throw_away(self) -> None:
        """Forget what has come until now."""
        with self._faults():
            if waiting := self._port.in_waiting:
                self._port.read(waiting)
        self._received.clear()

    def _send(self, text: str) -> None:
        data = text.encode("ascii") + self._dialect.end
        if self._is_cut:
            data = self._dialect.end + data
        self._is_cut = True
        with self._faults():
            self._port.write(data)
        self._is_cut = False

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except serial.SerialTimeoutException as error:
            self._is_in_step = False
            raise DeviceTimeout(f"{self.where} takes no commands; is it switched on?") from error
        except _FAULTS as error:
            raise Disconnected(f"{self.where} is gone; is it plugged in and switched on?") from error


def _open(port: str, dialect: Dialect, wire: Wire) -> Port:
    try:
        return wire.open_port(port, baudrate=dialect.baudrate, timeout=_SLICE_S, write_timeout=_WRITE_S, exclusive=True)
    except _FAULTS as error:
        raise _opening_error(port, dialect.device, error) from error


def _opening_error(port: str, device: str, error: BaseException) -> DeviceError:
    """Translate; where Windows refuses a port, pyserial tells only in its text why."""
    number, text = getattr(error, "errno", None), str(error)
    if number in {errno.EBUSY, errno.EAGAIN} or "PermissionError" in text:
        return Busy(f"another program holds {port}; close it to use the {device}")
    if number in {errno.EACCES, errno.EPERM}:
        return DeviceError(no_permission(port))
    if number in {errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO} or "FileNotFoundError" in text:
        return Disconnected(f"there is no {port}, so no {device}; {connected()}")
    return DeviceError(f"{port} cannot be opened as a serial port for the {device}: {text}")
