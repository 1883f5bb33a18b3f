"""`svwfs-window`, the window without a terminal: errors are shown in a dialog, once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from PyQt6.QtCore import QTimer
from PyQt6.QtWidgets import QApplication, QLabel, QMessageBox

from app.cli.window import main_window
from app.gui.shell.benches import BenchDialog
from app.gui.shell.main_window import MainWindow

pytestmark = pytest.mark.usefixtures("qapp", "display", "restored_theme", "runtime_folder")


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Windows as on a display, with settings of their own."""
    for room in ("commands.live", "cli.window"):
        monkeypatch.setattr(f"app.{room}.use_display", lambda: True)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr("app.gui.application.saved_state", lambda: None)


def start(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["svwfs-window", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main_window()
    assert isinstance(leaving.value.code, int)
    return leaving.value.code


@contextmanager
def watched(see: Callable[[], bool]) -> Iterator[None]:
    """Poll `see` from the event loop until it returns True."""
    timer = QTimer()

    def poll() -> None:
        if see():
            timer.stop()

    timer.timeout.connect(poll)
    timer.start(20)
    yield
    is_seen = not timer.isActive()
    timer.stop()
    assert is_seen


@contextmanager
def one_dialog() -> Iterator[list[str]]:
    """Close the message box that appears; its text and details are in the list."""
    told: list[str] = []

    def see() -> bool:
        box = QApplication.activeModalWidget()
        if isinstance(box, QMessageBox):
            told.extend([box.text(), box.detailedText()])
            box.accept()
        return bool(told)

    with watched(see):
        yield told


def test_error_before_the_window_opens_is_shown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with one_dialog() as told:
        assert start(monkeypatch, "--replay", tmp_path / "nothing") == 2
    assert told == [f"{tmp_path / 'nothing'}: no such folder", ""]


def test_usage_error_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    with one_dialog() as told:
        assert start(monkeypatch, "--nonsense") == 2
    assert told[0].startswith("Error: No such option: --nonsense")


def test_faulty_bench_is_shown_in_the_window_and_not_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("[sensor]\nlenslet_rows = -1\n")
    seen: list[str] = []

    def see() -> bool:
        assert QApplication.activeModalWidget() is None
        for window in QApplication.topLevelWidgets():
            if isinstance(window, MainWindow) and window.isVisible():
                dialog = window.findChild(BenchDialog)
                assert dialog is not None
                if dialog.isVisible():  # the file has been read
                    seen.extend(label.text() for label in dialog.findChildren(QLabel))
                    window.close()
        return bool(seen)

    monkeypatch.setattr("app.gui.widgets.theme.show_ending", lambda *_: pytest.fail("shown twice"))
    with watched(see):
        assert start(monkeypatch, "--bench", tmp_path / "bad.toml") == 2
    assert any("bad.toml: " in text and "missing" in text for text in seen)


def test_fault_of_the_program_is_shown_with_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.commands.live.bench_window", lambda *_, **__: 1 / 0)
    monkeypatch.setattr(sys, "stdout", None)  # as Windows starts it
    monkeypatch.setattr(sys, "stderr", None)
    with one_dialog() as told:
        assert start(monkeypatch) == 1
    assert told[0] == "ZeroDivisionError: division by zero"
    assert told[1].startswith("Traceback (most recent call last):")


def test_window_that_its_user_closes_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.commands.live.bench_window", lambda *_, **__: 0)
    monkeypatch.setattr("app.gui.widgets.theme.show_ending", lambda *_: pytest.fail("a dialog"))
    assert start(monkeypatch) == 0
