"""The one session that a process may have with the DCAM-API: the first user begins it, the last one ends it."""

from __future__ import annotations

import threading
from ctypes import byref
from dataclasses import dataclass

from drivers.dcam.library import DcamLibrary
from drivers.dcam.structures import Init, sized


@dataclass(slots=True)
class _Session:
    cameras: int
    users: int = 0


_sessions: dict[DcamLibrary, _Session] = {}
_lock = threading.Lock()


def begin(library: DcamLibrary) -> int:
    """Join or begin the session; return how many cameras it has. Cameras are looked for only when it begins."""
    with _lock:
        session = _sessions.get(library)
        if session is None:
            found = sized(Init)
            library.call("dcamapi_init", byref(found))
            session = _sessions[library] = _Session(found.iDeviceCount)
        session.users += 1
        return session.cameras


def end(library: DcamLibrary) -> None:
    """Leave the session. It ends with its last user: what another program has held can then be opened again."""
    with _lock:
        session = _sessions[library]
        session.users -= 1
        if not session.users:
            del _sessions[library]
            library.call("dcamapi_uninit")
