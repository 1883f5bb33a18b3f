"""A display counts only if it answers: Qt aborts with one that does not."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.commands.display import use_display

# A start of an instrument is only printed: one that a failed test left would run on.
_PROGRAM = """
import svwfs, sys
from app.acquisition.remote.own_instrument import OwnInstrument
OwnInstrument.start = lambda *_: print("an instrument is started")
sys.argv = ["svwfs", *sys.argv[1:]]
svwfs.main()
"""

pytestmark = pytest.mark.posix  # displays of Linux


@pytest.fixture(autouse=True)
def _no_display(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("QT_QPA_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture
def wayland(tmp_path: Path) -> Iterator[str]:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "wayland-7"))
        server.listen()
        yield "wayland-7"


def test_stale_display_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "wayland-0").touch()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    monkeypatch.setenv("DISPLAY", ":98765")
    assert not use_display()
    assert os.environ["QT_QPA_PLATFORM"] == "offscreen"


def test_answering_display_is_used(monkeypatch: pytest.MonkeyPatch, wayland: str) -> None:
    monkeypatch.setenv("WAYLAND_DISPLAY", wayland)
    assert use_display()
    assert os.environ["WAYLAND_DISPLAY"] == wayland
    assert "QT_QPA_PLATFORM" not in os.environ


def test_qt_of_other_programs_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYQTGRAPH_QT_LIB", "PySide6")
    use_display()
    assert os.environ["PYQTGRAPH_QT_LIB"] == "PyQt6"


def test_display_of_another_computer_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYLAND_DISPLAY", "gone")
    monkeypatch.setenv("DISPLAY", "server:0")
    assert use_display()
    assert "WAYLAND_DISPLAY" not in os.environ  # Qt would try it first


@pytest.mark.slow
@pytest.mark.parametrize("command", [("live",), ("live", "--seconds", "1"), ("benchmark", "--live", "5")])
def test_unusable_display_ends_the_program_before_an_instrument_is_started(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    environment = {**os.environ, "QT_QPA_PLATFORM": "none_such", "SVWFS_RUNTIME_DIR": str(tmp_path)}
    program = [sys.executable, "-c", _PROGRAM, *command]
    ended = subprocess.run(  # noqa: S603 - this interpreter
        program, check=False, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.splitlines()[-1].startswith("svwfs: no window can be opened: ")
