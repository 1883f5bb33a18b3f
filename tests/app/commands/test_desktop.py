"""`svwfs desktop`: the entry in the menu of a Linux desktop, and in the start menu of Windows."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from configparser import RawConfigParser
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID

import pytest
from PIL import Image
from support.command_line import run

from app.commands import desktop
from app.gui.shortcut import id_list, shortcut


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed `svwfs-window`, in a folder with characters that an entry must escape."""
    folder = tmp_path / ('a b$c%d"e\\f`g' if os.name == "posix" else "a b$c%d`g")
    folder.mkdir()
    monkeypatch.setattr(desktop, "sysconfig", SimpleNamespace(get_path={"scripts": str(folder)}.__getitem__))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    path = folder / "svwfs-window"
    path.touch()
    return path


@pytest.fixture
def entry(tmp_path: Path) -> Path:
    return tmp_path / "data" / "applications" / "svwfs.desktop"


def command_of(entry: Path) -> str:
    parser = RawConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign] # its keys keep their case
    parser.read(entry, "utf-8")
    assert parser.sections() == ["Desktop Entry"]
    assert (parser["Desktop Entry"]["Type"], parser["Desktop Entry"]["Terminal"]) == ("Application", "false")
    return parser["Desktop Entry"]["Exec"]


@pytest.mark.posix
def test_entry_starts_the_window_and_has_an_icon(
    program: Path, entry: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "desktop") == 0
    assert capsys.readouterr().out == f"entry: {entry}\n"
    # "Desktop Entry Specification", The Exec key: escaped in quotes, and each backslash once more as in any string
    assert command_of(entry) == f'"{tmp_path}/a b\\\\$c%%d\\\\"e\\\\\\\\f\\\\`g/{program.name}"'
    icon = tmp_path / "data" / "icons" / "hicolor" / "scalable" / "apps" / "svwfs.svg"
    assert icon.read_text("utf-8").startswith("<svg ")
    assert run(monkeypatch, "desktop") == 0  # replaces it
    assert run(monkeypatch, "desktop", "--remove") == 0
    assert not [path for path in (tmp_path / "data").rglob("*") if path.is_file()]
    assert run(monkeypatch, "desktop", "--remove") == 2
    assert "no such entry" in capsys.readouterr().err


@pytest.mark.posix
@pytest.mark.usefixtures("program")
def test_entry_opens_a_bench(
    entry: Path, small_toml: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(small_toml.parent)
    assert run(monkeypatch, "desktop", "--bench", f"./{small_toml.name}") == 0
    assert command_of(entry).endswith(f' "--bench" "{small_toml}"')  # wherever it is started
    assert run(monkeypatch, "desktop", "--bench", "live_demo") == 0
    assert command_of(entry).endswith(' "--bench" "live_demo"')
    entry.unlink()
    assert run(monkeypatch, "desktop", "--bench", "nowhere.toml") == 2
    assert "nowhere.toml: no such file" in capsys.readouterr().err
    assert not entry.exists()


@pytest.mark.posix
def test_missing_program_and_other_systems_are_refused(
    program: Path, entry: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program.unlink()
    assert run(monkeypatch, "desktop") == 1
    assert "install svwfs with uv, pipx or pip" in capsys.readouterr().err
    monkeypatch.setattr(desktop, "sys", SimpleNamespace(platform="darwin"))
    assert run(monkeypatch, "desktop") == 2
    assert "cannot be made on macOS: make a shortcut to" in capsys.readouterr().err
    assert not entry.exists()


class Reader(BytesIO):
    """Reads what [MS-SHLLINK] describes."""

    def number(self, size: int) -> int:
        return int.from_bytes(self.read(size), "little")

    def text(self) -> str:
        return self.read(2 * self.number(2)).decode("utf-16-le")


@pytest.mark.parametrize("folder", ["C:\\Users\\J\xfcrgen", "D:\\odd"])
def test_shortcut_has_the_parts_that_windows_reads(folder: str) -> None:
    arguments = ["--bench", "C:\\my benches\\b.toml"]
    program = Path(f"{folder}\\svwfs-window.exe")
    items = b"\x03\x00a\x00\x00"
    file = Reader(shortcut(program, items, arguments, folder=Path(folder), icon=Path("C:\\i.ico")))
    assert (file.number(4), UUID(bytes_le=file.read(16))) == (0x4C, UUID("00021401-0000-0000-C000-000000000046"))
    assert (
        file.number(4) == 0b11110011
    )  # HasLinkTargetIDList, HasLinkInfo, HasWorkingDir, HasArguments, HasIconLocation, IsUnicode
    assert file.read(0x24).strip(b"\0") == b""  # attributes, times, size, index of the icon
    assert (file.number(4), file.read(12)) == (1, bytes(12))  # SW_SHOWNORMAL; hot key, reserved
    assert file.read(file.number(2)) == items
    size = file.number(4)
    info = size.to_bytes(4, "little") + file.read(size - 4)
    _, header, flags, volume, path, network, suffix, wide, wide_suffix = struct.unpack_from("<9L", info)
    assert (header, flags, volume, network) == (0x24, 1, 0x24, 0)  # VolumeIDAndLocalBasePath
    assert struct.unpack_from("<4L", info, volume) == (path - volume, 3, 0, path - volume - 1)  # DRIVE_FIXED, no label
    assert info[path:suffix] == str(program).encode("ascii", "replace") + b"\0"
    assert info[wide:wide_suffix].decode("utf-16-le") == f"{program}\0"
    assert (info[suffix:wide], info[wide_suffix:]) == (b"\0", b"\0\0")
    assert [file.text() for _ in range(3)] == [folder, '--bench "C:\\my benches\\b.toml"', "C:\\i.ico"]
    block = Reader(file.read(file.number(4) - 4))
    assert file.read() == bytes(4)  # TerminalBlock
    assert block.number(4) == 0xA0000009  # PropertyStoreDataBlock
    storage = Reader(block.read(block.number(4) - 4))
    assert block.read() == bytes(4)  # no further storage
    assert storage.read(4) == b"1SPS"
    assert UUID(bytes_le=storage.read(16)) == UUID("9F4C2855-9F79-4B39-A8D0-E1D42DE1D5F3")  # PKEY_AppUserModel_ID
    value = Reader(storage.read(storage.number(4) - 4))
    assert storage.read() == bytes(4)  # no further value
    assert (value.number(4), value.read(1), value.number(2), value.read(2)) == (5, b"\0", 31, b"\0\0")  # VT_LPWSTR
    letters = value.number(4)
    assert value.read().decode("utf-16-le")[:letters] == "svwfs.window\0"


def test_start_menu_has_the_shortcut(
    program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program.with_name("svwfs-window.exe").touch()
    monkeypatch.setattr(desktop, "sys", SimpleNamespace(platform="win32"))
    monkeypatch.setattr("app.gui.shortcut.id_list", lambda _: b"\0\0")
    monkeypatch.setattr("platformdirs.user_data_path", lambda *, roaming: tmp_path / "data" if roaming else None)
    assert run(monkeypatch, "desktop", "--bench", "live_demo") == 0
    entry = tmp_path / "data" / "Microsoft" / "Windows" / "Start Menu" / "Programs" / "svwfs.lnk"
    assert capsys.readouterr().out == f"entry: {entry}\n"
    contents = entry.read_bytes()
    assert str(program.with_name("svwfs-window.exe")).encode("utf-16-le") in contents
    assert "--bench live_demo".encode("utf-16-le") in contents
    icon = files("app.gui") / "svwfs.ico"
    assert str(icon).encode("utf-16-le") in contents
    with icon.open("rb") as file, Image.open(file) as image:
        assert {(16, 16), (32, 32), (48, 48), (256, 256)} <= image.info["sizes"]
        assert len(set(image.convert("L").tobytes())) > 10  # a picture
    assert run(monkeypatch, "desktop", "--remove") == 0
    assert not entry.exists()


@pytest.mark.skipif(sys.platform != "win32", reason="asks the shell of Windows")
def test_the_shell_reads_the_shortcut(tmp_path: Path) -> None:
    program = Path(sys.executable)
    (tmp_path / "svwfs.lnk").write_bytes(
        shortcut(program, id_list(program), ["--bench", "x"], folder=tmp_path, icon=tmp_path)
    )
    ole = ctypes.OleDLL("ole32")  # type: ignore[attr-defined] # exists on Windows only
    ole.CoInitialize(None)
    link, file = ctypes.c_void_p(), ctypes.c_void_p()
    ole.CoCreateInstance(guid(SHELL_LINK), None, 1, guid(ISHELL_LINK), ctypes.byref(link))
    method(link, 0, guid(IPERSIST_FILE), ctypes.byref(file))
    method(file, 5, ctypes.c_wchar_p(str(tmp_path / "svwfs.lnk")), ctypes.c_int(0))  # Load
    texts = []
    for place in (3, 8, 10):  # GetPath, GetWorkingDirectory, GetArguments
        text = ctypes.create_unicode_buffer(260)
        more = (ctypes.c_void_p(), ctypes.c_int(0)) if place == 3 else ()
        method(link, place, text, ctypes.c_int(260), *more)
        texts.append(text.value)
    assert [text.lower() for text in texts] == [str(program).lower(), str(tmp_path).lower(), "--bench x"]


SHELL_LINK = "00021401-0000-0000-C000-000000000046"
ISHELL_LINK = "000214F9-0000-0000-C000-000000000046"
IPERSIST_FILE = "0000010B-0000-0000-C000-000000000046"


def guid(text: str) -> Any:
    return ctypes.create_string_buffer(UUID(text).bytes_le, 16)


def method(target: Any, place: int, *arguments: Any) -> None:
    """Call a method of a COM object by its place in its table."""
    table = ctypes.cast(target, ctypes.POINTER(ctypes.POINTER(ctypes.c_void_p))).contents
    kinds = [type(each) if type(each) in {ctypes.c_int, ctypes.c_wchar_p} else ctypes.c_void_p for each in arguments]
    prototype = ctypes.WINFUNCTYPE(ctypes.c_long, ctypes.c_void_p, *kinds)  # type: ignore[attr-defined] # exists on Windows only
    assert prototype(table[place])(target, *arguments) == 0
