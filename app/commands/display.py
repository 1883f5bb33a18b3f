"""The display: whether windows can be seen."""

import os
import re
import socket
import sys
from pathlib import Path

_PLATFORM = "QT_QPA_PLATFORM"
_LOCAL_X = re.compile(r"(?:unix)?:(\d+)(?:\.\d+)?")


def use_display() -> bool:
    """Return whether windows can be seen; if not, make Qt, which is not loaded yet, draw offscreen."""
    os.environ["PYQTGRAPH_QT_LIB"] = "PyQt6"  # another one may be chosen for other programs
    has_display = _has_display()
    if not has_display:
        os.environ[_PLATFORM] = "offscreen"
    return has_display


def _has_display() -> bool:
    if platform := os.environ.get(_PLATFORM):
        return platform != "offscreen"
    if not sys.platform.startswith("linux"):
        return True
    name = os.environ.get("WAYLAND_DISPLAY", "")
    if name and _answers(str(Path(os.environ.get("XDG_RUNTIME_DIR", "/"), name))):
        return True
    os.environ.pop("WAYLAND_DISPLAY", None)  # left by a session that has ended: Qt would abort
    local = _LOCAL_X.fullmatch(os.environ.get("DISPLAY", ""))
    if local is None:
        return bool(os.environ.get("DISPLAY"))  # on another computer
    path = f"/tmp/.X11-unix/X{local[1]}"  # noqa: S108 - where X11 has it
    return _answers(path) or _answers(f"\0{path}")


def _answers(path: str) -> bool:
    """True if something listens at a local socket."""
    if sys.platform == "win32":
        return False
    with socket.socket(socket.AF_UNIX) as client:
        try:
            client.connect(path)
        except OSError:
            return False
    return True
