"""Timed faults: a fault in the middle of a call, and errors that must come in time."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

import pytest

from drivers.interface import DeviceError
from support.patience import HANG_S, own_time

AT_ONCE_S = 2.0  # until a pulled plug must be noticed
_PAUSE_S = 0.03


def after_pause(happen: Callable[[], None], clock: Callable[[], float]) -> Callable[[], float]:
    """Call `happen` from another thread after a pause; the result returns when, on that clock."""
    happened_s: list[float] = []

    def act() -> None:
        happened_s.append(clock())
        happen()

    timer = threading.Timer(_PAUSE_S, act)
    timer.start()

    def when() -> float:
        timer.join()
        return happened_s[0]

    return when


def expect_within(kind: type[DeviceError], call: Callable[[], object]) -> None:
    """Expect the error in time."""
    with own_time() as elapsed_s:
        with pytest.raises(kind):
            call()
        assert elapsed_s() < AT_ONCE_S


def repeat(call: Callable[[], object]) -> None:
    """Call until it fails, with a short switch interval, so that another thread acts during a call."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        deadline_s = time.monotonic() + HANG_S
        while time.monotonic() < deadline_s:
            call()
    finally:
        sys.setswitchinterval(before_s)
