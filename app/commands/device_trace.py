"""Trace of the calls to a device and its answers, without serial numbers, for `svwfs devices --check`."""

import re
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from drivers.device import Property
from drivers.interface import Frame

_MOST_CALLS = 10  # kept
_LONGEST = 100  # characters of an answer
_SERIAL = re.compile(r"\b(?=\w*\d{5})\w+\b")  # of five digits or more, as M00331234
_OWN_KEYS = ("serial", "cameraid", "userid")
_HIDDEN = "(serial number)"


class Trace:
    """A device that notes its last calls, answers and their durations."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self.calls: deque[str] = deque(maxlen=_MOST_CALLS)

    def __getattr__(self, name: str) -> Any:
        with self._noted(name) as answers:
            value = getattr(self._device, name)
            if not callable(value):
                answers.append(value)
                return value

        def call(*arguments: object) -> Any:
            with self._noted(f"{name}({', '.join(map(repr, arguments))})") as answers:
                answers.append(value(*arguments))
            return answers[0]

        return call

    @contextmanager
    def _noted(self, what: str) -> Iterator[list[Any]]:
        """Note the answer that the block appends, or its error; nothing if there is neither."""
        answers: list[Any] = []
        start_s = time.perf_counter()
        try:
            yield answers
        except Exception as error:
            answers.append(f"{type(error).__name__}: {error}")
            raise
        finally:
            if answers:
                took_s = time.perf_counter() - start_s
                self.calls.append(f"{what} -> {_short(answers[0])}, {took_s:.3f} s")


def serial_numbers(name: str, settings: Mapping[str, object], properties: Mapping[str, Property]) -> frozenset[str]:
    """Texts that identify this one device rather than its model."""
    keys = (
        ("serial_number",) if "adapter" in settings else ("device", "serial_number")
    )  # an adapter's device is a model
    found = {str(settings.get(key) or "") for key in keys}
    found |= {str(value) for key, value in properties.items() if any(own in key.lower() for own in _OWN_KEYS)}
    for text in (name, *properties.values()):
        if isinstance(text, str) and not _is_number(text):
            found |= set(_SERIAL.findall(text))
    return frozenset(text for text in found if len(text) > 3)  # a shorter one is an index


def hide(text: str, secrets: frozenset[str]) -> str:
    """Replace the secrets and the home folder."""
    for secret in sorted(secrets, key=len, reverse=True):
        text = text.replace(secret, _HIDDEN)
    return text.replace(str(Path.home()), "~")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _short(answer: object) -> str:
    if isinstance(answer, Frame):
        rows, columns = answer.pixels.shape
        least, most = answer.pixels.min(), answer.pixels.max()
        return f"frame {answer.index}, {rows} x {columns}, counts {least} ... {most}, exposed {answer.exposure_s:g} s"
    text = f"{len(answer)} values" if isinstance(answer, Mapping) else str(answer)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
