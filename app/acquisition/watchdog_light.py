"""A light that lives in a watchdog process, so that it goes off whatever happens to this one.

If the watchdog ends or gives no sign of life, this process switches the light off itself, and every call fails.
"""

import dataclasses
import json
import math
import os
import queue
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial
from typing import IO, Any, cast

from app.acquisition import watchdog
from app.bench.device_kinds import DeviceSettings
from app.progress import run_in_thread
from drivers import errors
from drivers.device import Property, Range
from drivers.errors import DeviceError
from drivers.light_source import MAY_BE_ON, LightSource
from reconstruction.runtime.child_process import Child, start_child

_SILENT_PULSES = 5  # after so many missing signs of life the watchdog counts as frozen, or its light's call as hanging
_ANSWER_S = 2.0  # after which a light counts as silent: most need a fraction of it
_END_S = 3.0  # for the watchdog to end
_TAKE_OVER_S = 20.0  # for a light that may hang here, too
_SIGN_S = 0.2  # least time between two signs of life that promise the same


class WatchdogLight(LightSource):
    """The light with these settings, opened by a watchdog of its own.

    Until the first `keep_alive`, only the end or a freeze of this process switches it off.
    """

    def __init__(self, settings: DeviceSettings) -> None:
        super().__init__()
        self._watchdog = _Watchdog(dataclasses.asdict(settings))
        self._sent_s, self._promised_s = 0.0, 0.0
        try:
            self._name = str(self._watchdog.answer())
        except BaseException:
            self._watchdog.end()
            raise
        self._begin()

    def properties(self) -> dict[str, Property]:
        """Properties of the light in the watchdog."""
        with self._guarded():
            found: dict[str, Property] = self._watchdog.call("properties")
            return found

    @property
    def watchdog(self) -> Child:
        """The process that holds the light."""
        return self._watchdog.process

    @property
    def is_silent(self) -> bool:
        """True if the watchdog has not answered a call for two seconds."""
        return time.monotonic() > self._watchdog.called_s + _ANSWER_S

    def keep_alive(self, within_s: float) -> None:
        """Send the watchdog a sign of life, several times a second at most."""
        now_s = time.monotonic()
        if within_s != self._promised_s or now_s > self._sent_s + _SIGN_S:
            self._promised_s, self._sent_s = within_s, now_s
            self._watchdog.tell("keep_alive", within_s)

    @property
    def _may_shine(self) -> bool:
        return not self._watchdog.was_taken_over

    def _read_range(self) -> Range:
        return Range(**self._watchdog.call("current_range_a"))

    def _read_current(self) -> float:
        return float(self._watchdog.call("current_a"))

    def _set_current(self, current_a: float) -> float:
        return float(self._watchdog.call("set_current", current_a))

    def _is_lit(self) -> bool:
        is_lit = bool(self._watchdog.call("is_on"))
        if not is_lit and self._is_noted_lit:
            self._note_went_off(self._watchdog.call("off_reason"))
        return is_lit

    def _switch(self, *, on: bool) -> None:
        if on or not self._watchdog.was_taken_over:
            self._watchdog.call("set_on", on)

    def _close(self) -> None:
        try:
            self._watchdog.call("close")
        finally:
            self._watchdog.end()


class _Watchdog:
    """The process of the watchdog; threads hear what it says, and notice its end."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.was_taken_over = False  # the watchdog is gone, and this process has switched its light off
        self._settings = settings
        self._number = 0  # of the last call
        self.called_s = math.inf  # when the call was made that waits for its answer
        self._answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._writing = threading.Lock()
        self._has_ended = threading.Event()
        self._has_pulse = False
        self.process = start_child(
            # svwfs first: the folder of the user's script may have modules with the names of our packages
            f"import svwfs; from {watchdog.__name__} import main; main()",
            environment={"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._listen, self._watch)]
        for thread in self._threads:
            thread.start()
        self._write(settings)

    def call(self, method: str, *arguments: Any) -> Any:
        """Return what the light answers, or raise its error; one thread at a time, as for every device."""
        self._number += 1
        self.called_s = time.monotonic()
        try:
            self._write([self._number, method, *arguments])
            return self.answer()
        finally:
            self.called_s = math.inf

    def tell(self, method: str, *arguments: Any) -> None:
        """Send what has no answer."""
        self._write([0, method, *arguments])

    def answer(self) -> Any:
        """Wait for the answer to the last call; after Ctrl-C, those to others may come before it.

        The end of the watchdog answers all calls.
        """
        answer = self._answers.get()
        while answer.get("to", self._number) != self._number:
            answer = self._answers.get()
        if "error" not in answer:
            return answer["value"]
        if "to" not in answer:
            self._answers.put(answer)
        raise getattr(errors, answer["error"], DeviceError)(answer["text"])  # a driver may have an error of its own

    def end(self) -> None:
        """Let the watchdog end, which switches the light off; kill it if it does not."""
        with self._writing, suppress(OSError):
            self._input.close()
        self._end_within(_END_S)
        for thread in self._threads:
            thread.join(_END_S)

    @property
    def _input(self) -> IO[bytes]:
        return cast("IO[bytes]", self.process.stdin)

    def _write(self, line: Any) -> None:
        with self._writing, suppress(OSError, ValueError):  # of a watchdog that has ended: `_watch` notices
            self._input.write(json.dumps(line).encode() + b"\n")
            self._input.flush()

    def _end_within(self, seconds: float) -> None:
        """Kill the process if it does not end in time; one that hangs in the kernel may continue."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)
        self.process.kill()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(_END_S)

    def _listen(self) -> None:
        with cast("IO[bytes]", self.process.stdout) as lines:
            for line in lines:
                self._has_pulse = True
                try:
                    answer = dict(json.loads(line))
                except (TypeError, ValueError):  # printed by a library
                    continue
                if "alive" in answer:
                    self.tell("alive")
                else:
                    self._answers.put(answer)
        self._has_ended.set()

    def _watch(self) -> None:
        """Answer all calls when the watchdog has ended, or is killed because it is frozen or its light hangs.

        The pulses that are missing are counted, as this process may be late.
        """
        missing = -watchdog.STARTING_PULSES
        while missing < _SILENT_PULSES and not self._has_ended.wait(watchdog.PULSE_S):
            missing, self._has_pulse = 0 if self._has_pulse else missing + 1, False
        self._end_within(_END_S if self._has_ended.is_set() else 0.0)
        is_over = self.process.returncode == 0
        error, text = ("WrongState", "the light is closed") if is_over else ("Disconnected", self._take_over())
        self._answers.put({"error": error, "text": text})

    def _take_over(self) -> str:
        """Switch the light off from this process; say what has happened, whatever fails."""
        text = f"the watchdog of the light {'cannot be' if self.process.returncode is None else 'has'} ended"
        try:
            run_in_thread(partial(watchdog.switch_off, self._settings), "light off")[0].result(_TAKE_OVER_S)
        except Exception as error:  # noqa: BLE001 - its text is returned
            why = str(error) or f"it does not answer within {_TAKE_OVER_S:g} s"
            text += f", and the light cannot be reached ({why}); {MAY_BE_ON}"
        else:
            self.was_taken_over = True
            text += "; the light was switched off: open the bench again"
        sys.stderr.write(f"svwfs: {text}\n")
        return text
