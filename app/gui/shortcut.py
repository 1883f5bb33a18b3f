"""Windows: the shortcut in the start menu, and the identity that joins it with the window in the taskbar."""

import ctypes
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from struct import pack
from uuid import UUID

IDENTITY = "svwfs.window"  # AppUserModelID of shortcut and process

_SHELL_LINK = UUID("00021401-0000-0000-c000-000000000046").bytes_le
_APP_USER_MODEL = UUID("9f4c2855-9f79-4b39-a8d0-e1d42de1d5f3").bytes_le  # property 5 is the identity
_FLAGS = 0x1 | 0x2 | 0x10 | 0x20 | 0x40 | 0x80  # ID list, path, working folder, arguments, icon; UTF-16
_VOLUME = pack("<LLLLx", 17, 3, 0, 16)  # a fixed disk without a name


def shortcut(program: Path, items: bytes, arguments: Sequence[str], *, folder: Path, icon: Path) -> bytes:
    """Return a shortcut (.lnk) to a program with the ID list `items` ([MS-SHLLINK], version 8.0)."""
    path = str(program).encode("ascii", "replace") + b"\0\0"  # and no suffix
    wide = f"{program}\0\0".encode("utf-16-le")
    at = 36 + len(_VOLUME), 36 + len(_VOLUME) + len(path)  # of the two
    place = pack("<9L", at[1] + len(wide), 36, 1, 36, at[0], 0, at[1] - 1, at[1], at[1] + len(wide) - 2)
    place += _VOLUME + path + wide
    header = pack("<L16sLL24xLLL12x", 0x4C, _SHELL_LINK, _FLAGS, 0, 0, 0, 1)
    texts = (str(folder), subprocess.list2cmdline(arguments), str(icon))
    strings = b"".join(pack("<H", len(text.encode("utf-16-le")) // 2) + text.encode("utf-16-le") for text in texts)
    name = f"{IDENTITY}\0".encode("utf-16-le")
    name += bytes(-len(name) % 4)
    value = pack("<LLxHHL", 17 + len(name), 5, 0x1F, 0, len(IDENTITY) + 1) + name
    storage = pack("<L4s16s", 28 + len(value), b"1SPS", _APP_USER_MODEL) + value + bytes(8)
    properties = pack("<LL", 8 + len(storage), 0xA0000009) + storage
    return header + pack("<H", len(items)) + items + place + strings + properties + bytes(4)


def id_list(program: Path) -> bytes:
    """Return the ID list by which the shell of Windows names a file; `OSError` if there is no such file."""
    if sys.platform != "win32":
        raise NotImplementedError
    shell = ctypes.WinDLL("shell32")
    shell.ILCreateFromPathW.restype = ctypes.c_void_p
    if not (items := shell.ILCreateFromPathW(str(program))):
        raise OSError(f"{program}: the shell knows no such file")
    return ctypes.string_at(items, shell.ILGetSize(ctypes.c_void_p(items)))


def take_identity() -> None:
    """Let the taskbar show windows of this process under the icon of svwfs, not under that of Python."""
    if sys.platform == "win32":
        ctypes.windll.shell32.SetCurrentProcessExplicitAppUserModelID(IDENTITY)
