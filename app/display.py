"""Whether there is a display for a window."""

from __future__ import annotations

import os
import sys

_PLATFORM = "QT_QPA_PLATFORM"


def use_display() -> bool:
    """Return whether a window can be seen; where not, have Qt, which is not loaded here, draw windows unseen."""
    is_there = _has_display()
    if not is_there:
        os.environ[_PLATFORM] = "offscreen"
    return is_there


def _has_display() -> bool:
    if platform := os.environ.get(_PLATFORM):
        return platform != "offscreen"
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
