"""Detection of a display for windows."""

import os
import sys

_PLATFORM = "QT_QPA_PLATFORM"


def use_display() -> bool:
    """Return whether windows can be seen; if not, make Qt, which is not loaded yet, draw offscreen."""
    has_display = _has_display()
    if not has_display:
        os.environ[_PLATFORM] = "offscreen"
    return has_display


def _has_display() -> bool:
    if platform := os.environ.get(_PLATFORM):
        return platform != "offscreen"
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
