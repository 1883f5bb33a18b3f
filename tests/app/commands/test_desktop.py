"""`svwfs desktop`: the entry in the menu of a Linux desktop."""

from __future__ import annotations

import sys
from configparser import RawConfigParser
from pathlib import Path

import pytest
from support.command_line import run


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed `svwfs-window`, in a folder with characters that an entry must escape."""
    folder = tmp_path / 'a b$c%d"e\\f`g'
    folder.mkdir()
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
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


def test_missing_program_and_other_systems_are_refused(
    program: Path, entry: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program.unlink()
    assert run(monkeypatch, "desktop") == 1
    assert "install svwfs with pip or pipx" in capsys.readouterr().err
    monkeypatch.setattr(sys, "platform", "win32")
    assert run(monkeypatch, "desktop") == 2
    assert "on Linux only: make a shortcut to" in capsys.readouterr().err
    assert not entry.exists()
