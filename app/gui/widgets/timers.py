"""Timers, and the pace of the window."""

from collections.abc import Callable

from PyQt6.QtCore import QObject, QTimer

REFRESH_MS = 40  # 25 times a second


def timer(parent: QObject, interval_ms: int, act: Callable[[], object], *, is_single: bool = False) -> QTimer:
    """Make a timer, stopped, that calls `act`."""
    made = QTimer(parent)
    made.setInterval(interval_ms)
    made.setSingleShot(is_single)
    made.timeout.connect(act)
    return made
