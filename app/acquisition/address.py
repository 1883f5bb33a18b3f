"""Address of a running instrument and the key to it, in a folder of this user alone."""

import json
import os
import secrets
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

from app.errors import InputError, RunError
from app.files import file_name_problem, has_locked
from reconstruction.runtime.renaming import rename

if sys.platform != "win32":
    import fcntl

NAME = "instrument"
CLOSING_S = 45.0  # until a closed instrument ends: a frame of the slowest method takes up to half of it
DYING_S = 0.5  # for a killed process to give its files back
_FOLDER = "SVWFS_RUNTIME_DIR"
_LASTING = "lock", "log"  # endings of what stays when an instrument has ended
_LOG_BYTES = 1_000_000  # a vendor's library may print at every frame
_TIMEOUT_S = 1.0  # for a client that looks at this moment whether the last instrument was killed


class NotRunning(RunError):
    """No instrument runs under a name."""


class NameTaken(RunError):
    """Another instrument runs under a name."""


@dataclass(frozen=True, slots=True)
class Address:
    """Address of a running instrument."""

    name: str
    process: int
    endpoint: str  # ZeroMQ's
    key: str  # every message must have it

    @classmethod
    def of(cls, name: str = NAME) -> Self:
        """Read the address of the instrument that runs under a name; `NotRunning` if there is none."""
        file = file_of(name, "json")
        clear_abandoned(name)
        try:
            return cls(**json.loads(file.read_text()))
        except OSError as error:
            named = ("", "") if name == NAME else (f" as {name}", f" --name {name}")
            sentence = f"no instrument runs{named[0]}: start one with svwfs serve --bench BENCH{named[1]}"
            raise NotRunning(sentence) from error
        except (ValueError, TypeError) as error:
            raise RunError(f"{file} cannot be read: start the instrument again") from error

    def announce(self) -> None:
        """Let clients find it, now that it can be reached."""
        file = file_of(self.name, "json")
        part = file.with_suffix(".part")
        part.touch(mode=0o600)
        part.write_text(json.dumps(asdict(self)))
        rename(part, file)


def is_taken(name: str) -> bool:
    """Return whether an instrument can be reached under a name."""
    try:
        Address.of(name)
    except RunError:
        return False
    return True


def running() -> tuple[str, ...]:
    """Return the names of this user's instruments that can be reached."""
    return tuple(sorted(file.stem for file in runtime_folder().glob("*.json") if is_taken(file.stem)))


@contextmanager
def taken_address(name: str = NAME) -> Iterator[Address]:
    """Take the address of a name for this process until the end of a `with`.

    What a killed instrument left there is replaced. `RunError` if another one runs there; `InputError` for a bad name.
    """
    with _lock(name, _TIMEOUT_S):
        _clear(name)
        endpoint = f"ipc://{file_of(name, 'socket')}" if os.name == "posix" else "tcp://127.0.0.1:*"
        try:
            yield Address(name, os.getpid(), endpoint, secrets.token_hex(16))
        finally:
            _clear(name)


def clear_abandoned(name: str, *, timeout_s: float = 0.0) -> None:
    """Remove the files of a killed instrument."""
    if file_of(name, "json").exists():
        with suppress(RunError), _lock(name, timeout_s):  # held while one runs
            _clear(name)


@contextmanager
def _lock(name: str, timeout_s: float) -> Iterator[None]:
    """Hold a lock that ends with this process at the latest; `RunError` if another one holds it.

    The folder is locked, too: programs that remove old temporary files leave a locked folder alone.
    """
    with ExitStack() as stack:
        lock = os.open(file_of(name, "lock"), os.O_RDWR | os.O_CREAT, 0o600)
        stack.callback(os.close, lock)
        until_s = time.monotonic() + timeout_s
        while not has_locked(lock):
            if time.monotonic() > until_s:
                raise RunError(f"an instrument named {name} is running already: stop it, or choose another --name")
            time.sleep(0.01)
        if sys.platform != "win32":
            stack.callback(os.close, folder := os.open(runtime_folder(), os.O_RDONLY))
            fcntl.flock(folder, fcntl.LOCK_SH)
        yield


def bound_log(name: str) -> None:
    """Empty the log of an instrument if it has grown too large."""
    with suppress(OSError):  # there is none
        if (of_log := (log := file_of(name, "log")).stat()).st_size > _LOG_BYTES:
            os.truncate(log, 0)
            if os.path.samestat(of_log, os.fstat(2)):  # on Windows this process would write where it stood
                os.lseek(2, 0, os.SEEK_SET)


def _clear(name: str) -> None:
    """Remove the files of a running instrument: its address, on some systems socket and ring."""
    pattern = file_of(name, "*")
    for file in pattern.parent.glob(pattern.name):
        if file.suffix.removeprefix(".") not in _LASTING:
            with suppress(OSError):  # gone already; or Windows keeps a file that a client has open
                file.unlink()


def file_of(name: str, ending: str) -> Path:
    """Path of a file of an instrument; `InputError` if that cannot be its name."""
    if not (isinstance(name, str) and name.isidentifier()):
        raise InputError(f"an instrument cannot have the name {name!r}: use letters, digits and _")
    if problem := file_name_problem(name):
        raise InputError(f"an instrument cannot have the name {name!r}: it {problem}")
    return runtime_folder() / f"{name}.{ending}"


def runtime_folder() -> Path:
    """The folder of all instruments of this user, made if need be.

    It is the same for a desktop, a service and cron: in /tmp, as XDG_RUNTIME_DIR and TMPDIR are not set in all of them.
    The variable SVWFS_RUNTIME_DIR names another place. `RunError` if it belongs to someone else or others may enter it.
    """
    if sys.platform == "win32":  # the temporary folder is a user's own, where access lists protect it
        made = Path(os.environ.get(_FOLDER) or tempfile.gettempdir(), "svwfs")
    else:
        made = Path(os.environ.get(_FOLDER) or "/tmp", f"svwfs-{os.getuid()}")  # noqa: S108 - its owner is checked
    try:
        made.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise RunError(f"{made} cannot be made for the instrument's address: {error.strerror}") from error
    if sys.platform != "win32":
        found = made.lstat()  # a link is refused, too
        if found.st_uid != os.getuid():  # only root or that user can remove it
            raise RunError(f"{made} belongs to another user: set {_FOLDER} to a folder of yours, in every program")
        if stat.S_IMODE(found.st_mode) & 0o077:
            raise RunError(f"{made} is open to others: remove it, or chmod 700 it")
    return made
