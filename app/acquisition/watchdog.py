"""The watchdog: a process that holds the light, and switches it off when the instrument fails.

The light goes off when the instrument's process has ended in any way, closes the pipe, is frozen, or breaks its
promise to send a sign of life. `WatchdogLight` calls the light through it, over JSON lines: first the settings of the
light; then [number, method or property, argument...], answered by {"to": number, "value": ...} or {"to": number,
"error": class, "text": ...}. Number 0 has no answer: [0, "keep_alive", seconds] is a sign of life of the worker, whose
promise every call renews. {"alive": true} comes four times a second, unless a call of the light hangs; a thread of the
instrument replies [0, "alive"], whatever its worker does. The exit status is 0 if the light was closed in order.
"""

import json
import math
import os
import queue
import signal
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict
from typing import Any

from app.bench.device_kinds import DRIVERS
from app.errors import ENDING
from drivers.errors import DeviceError
from drivers.light_source import MAY_BE_ON, LightSource
from reconstruction.runtime.child_process import Parent, take_pipes

PULSE_S = 0.25  # between two signs of life of the watchdog
STARTING_PULSES = 240  # before the first one is heard: a cold disk takes long to import
_SILENT_PULSES = 6  # without an answer or any work, and the instrument counts as frozen
_HANGING_PULSES = 40  # in one call of the light: drivers give up after 8 s (DC2200) or less
_POLL_S = 0.05  # how late the end of a process whose pipe stays open is noticed
_ATTEMPTS = 3  # to reach a light that could not be switched off


class _Pipe:
    """The lines from and to the instrument; what libraries print goes to the error stream."""

    def __init__(self) -> None:
        self._input, self._output = take_pipes()
        self._writing = threading.Lock()
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._parent, self.has_ended = Parent(), False
        self._unanswered = self.pulses_in_call = -STARTING_PULSES
        for work in (self._read, self._pulse):
            threading.Thread(target=work, daemon=True).start()

    def send(self, answer: dict[str, Any]) -> None:
        with self._writing, suppress(OSError, ValueError):  # of an instrument that has ended
            self._output.write(json.dumps(answer, default=asdict).encode() + b"\n")
            self._output.flush()

    def next(self, timeout_s: float) -> bytes:
        """Return the next line, or an empty one if none came in time or there are no more."""
        with suppress(queue.Empty):
            return self._lines.get(timeout=timeout_s)
        if self._parent.has_ended:  # a process forked from it may hold the pipe open
            self.has_ended = True  # not False again: `_read` may have set it meanwhile
        return b""

    def _read(self) -> None:
        for line in self._input:
            self._unanswered = 0
            self._lines.put(line)
        self.has_ended = True
        self._lines.put(b"")

    def _pulse(self) -> None:
        worked_s = 0.0
        while True:
            if self.pulses_in_call < _HANGING_PULSES:
                self.send({"alive": True})
                self._unanswered += 1
            elif self.has_ended:  # nobody is left to end this process, which holds the device
                os._exit(1)
            self.pulses_in_call += 1
            time.sleep(PULSE_S)
            before_s, worked_s = worked_s, self._parent.processor_s
            if worked_s != before_s:  # a thread that computes may let no other one answer: this is no freeze
                self._unanswered = min(self._unanswered, 0)
            if self._unanswered == _SILENT_PULSES:
                self._lines.put(b'[0, "frozen"]')


def _serve(light: LightSource, pipe: _Pipe) -> None:
    """Answer calls until the pipe ends or the light is closed."""
    due_s = promised_s = math.inf
    while not pipe.has_ended:
        pipe.pulses_in_call = 0
        line = pipe.next(_POLL_S)
        if line:
            number, method, *arguments = json.loads(line)
            if number:
                pipe.send({"to": number} | _answer(light, method, arguments))
                if method == "close":
                    return
            elif method == "keep_alive":
                promised_s = float(arguments[0])
            elif method == "frozen":
                _end_silence(light, _SILENT_PULSES * PULSE_S)
            if number or method == "keep_alive":
                due_s = time.monotonic() + promised_s  # the light may have answered late
        elif time.monotonic() > due_s and not pipe.has_ended:
            due_s = math.inf
            _end_silence(light, promised_s)


def _end_silence(light: LightSource, silent_s: float) -> None:
    """Switch the light off and say why; if it fails, end, which tries again."""
    silence = f"the acquisition gave no sign of life for {silent_s:g} s"
    try:
        if not light.is_on:
            return
        light.set_on(False)
    except DeviceError as error:
        sys.exit(f"svwfs: {silence}, and the light failed: {error}")
    light.off_reason = f"the light went off because {silence}"
    sys.stderr.write(f"svwfs: {light.off_reason}\n")


def _answer(light: LightSource, method: str, arguments: list[Any]) -> dict[str, Any]:
    try:  # a light is opened off, and its own rules hold here, too
        value = getattr(light, method)
        return {"value": value(*arguments) if callable(value) else value}
    except DeviceError as error:
        return {"error": type(error).__name__, "text": str(error)}


def open_light(settings: dict[str, Any]) -> LightSource:
    """Open the light that has these settings, off."""
    kind = DRIVERS["light"][settings["driver"]]
    light: LightSource = kind.open(kind.settings(**settings))
    return light


def switch_off(settings: dict[str, Any]) -> None:
    """Switch off, by opening, a light that nobody holds; `DeviceError` after several attempts."""
    for attempt in range(_ATTEMPTS):
        try:
            open_light(settings).close()
        except DeviceError:
            if attempt == _ATTEMPTS - 1:
                raise
            time.sleep(PULSE_S)
        else:
            return


def main() -> None:
    """Hold the light until the instrument closes it or ends."""
    for number in ENDING:
        signal.signal(number, lambda *_: sys.exit(1))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the instrument decides
    pipe = _Pipe()
    settings = json.loads(pipe.next(PULSE_S * 40) or b"{}")
    if not settings:
        return
    try:
        light = open_light(settings)
    except DeviceError as error:
        pipe.send({"error": type(error).__name__, "text": str(error)})
        return
    try:
        pipe.send({"value": light.name})
        _serve(light, pipe)
    finally:
        pipe.pulses_in_call = -STARTING_PULSES  # several attempts may take long
        try:
            light.close()
        except Exception:  # noqa: BLE001 - nobody else is left to try again
            try:
                switch_off(settings)
            except Exception as error:  # noqa: BLE001 - it is printed
                sys.exit(f"svwfs: {error}; {MAY_BE_ON}")
