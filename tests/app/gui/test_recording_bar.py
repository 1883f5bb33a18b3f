"""The recording bar, by clicks and keys."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from PyQt6.QtCore import QProcess, QSettings, Qt, QUrl
from PyQt6.QtGui import QDesktopServices
from PyQt6.QtWidgets import QFileDialog, QLineEdit, QMenu
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import MakeWindow, press

from app.gui.shell.main_window import MainWindow
from app.gui.shell.menus import RecentFiles
from app.recording.reader import Recording


def type_into(qtbot: QtBot, field: QLineEdit, text: str) -> None:
    field.setFocus()
    field.selectAll()
    qtbot.keyClicks(field, text)  # type: ignore[no-untyped-call] # pytest-qt declares no types for it
    press(qtbot, field, Qt.Key.Key_Return)


def record(qtbot: QtBot, window: MainWindow, folder: Path, *, frames: int) -> None:
    """Record some frames by the limit of the bar."""
    window.recording_bar.recordings_folder = folder
    bar = window.recording_bar
    line = bar.stop_after.lineEdit()
    assert line is not None
    type_into(qtbot, line, str(frames))
    press(qtbot, window, Qt.Key.Key_W)
    qtbot.waitUntil(lambda: bar.folder is not None)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders and files that the desktop was asked to open."""
    paths: list[Path] = []

    def open_url(url: QUrl) -> bool:
        paths.append(Path(url.toLocalFile()))
        return True

    monkeypatch.setattr(QDesktopServices, "openUrl", open_url)
    return paths


@pytest.mark.slow
def test_recording_without_frames_offers_only_its_folder(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, camera = live
    bar = window.recording_bar
    bar.recordings_folder = tmp_path
    press(qtbot, window, Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: not camera.is_running and window.controller.is_settled)
    press(qtbot, window, Qt.Key.Key_W)
    qtbot.waitUntil(lambda: bar._stage == "recording")
    press(qtbot, window, Qt.Key.Key_W)
    window.messages.accept.click()  # the key asks
    qtbot.waitUntil(lambda: bar.folder is not None)
    assert bar.text.text().startswith("0 frames in ")
    assert [each.isVisible() for each in (bar.open, bar.replay, bar.report, bar.export)] == [True, False, False, False]


@pytest.mark.slow
def test_recording_ends_by_itself_with_name_and_note(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, opened: list[Path]
) -> None:
    window, _ = live
    bar = window.recording_bar
    assert not bar.isVisible()
    window.activateWindow()
    window.recording_panel.next.click()
    assert bar.stop_after.isVisible()
    type_into(qtbot, bar.name, "mouse 7 ")
    assert not bar.name.styleSheet()  # the space at its end is harmless
    type_into(qtbot, bar.note, "3 % agarose")
    record(qtbot, window, tmp_path, frames=4)
    qtbot.waitUntil(lambda: "Saved as " in window.messages.log)
    (folder,) = tmp_path.iterdir()
    assert folder == bar.folder
    assert folder.name.endswith("-mouse 7")
    recording = Recording(folder)
    assert len(recording) == 4
    assert recording.run["note"] == "3 % agarose"
    assert bar.text.text() == f"4 frames in {folder.name}"
    assert not bar.stop_after.isVisible()
    assert not bar.limit.frames  # of the next recording
    bar.open.click()
    assert opened == [folder]
    bar.done.click()
    assert not bar.isVisible()
    bar.prepare()
    window.update_text()
    assert bar.text.text() == "Next recording"  # the finished one does not come back, to take its name
    assert bar.stop_after.isVisible()


@pytest.mark.slow
@pytest.mark.long
def test_name_given_afterwards_renames_the_folder(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, camera = live
    record(qtbot, window, tmp_path, frames=2)
    bar = window.recording_bar
    bar.note.setText("fed at noon")
    bar.name.setFocus()
    qtbot.keyClicks(bar.name, "a/b")  # type: ignore[no-untyped-call] # pytest-qt declares no types for it
    window.update_text()
    assert window.messages.text.text() == "A name of a recording cannot contain /"  # while it is typed
    assert "color" in bar.name.styleSheet()
    press(qtbot, bar.name, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: "a name of a recording cannot contain /: a/b" in window.messages.log.lower())
    assert Recording(next(tmp_path.iterdir())).run["note"] == "fed at noon"
    type_into(qtbot, bar.name, "sl")  # letters that are commands outside the field
    qtbot.waitUntil(lambda: [path.name[15:] for path in tmp_path.iterdir()] == ["-sl"])
    assert camera.stage.is_sample_in
    assert camera.light.shines
    bar.name.setFocus()
    qtbot.keyClicks(bar.name, "x")  # type: ignore[no-untyped-call] # pytest-qt declares no types for it
    press(qtbot, bar.name, Qt.Key.Key_Escape)
    assert bar.name.text() == "slx"  # Esc erases nothing
    press(qtbot, window, Qt.Key.Key_W)  # the next one has no name
    qtbot.waitUntil(lambda: sorted(path.name[15:] for path in tmp_path.iterdir()) in (["", "-slx"], ["-2", "-slx"]))


@pytest.mark.slow
@pytest.mark.long
def test_report_and_export_run_beside_the_window(
    live: tuple[MainWindow, FakeCamera],
    qtbot: QtBot,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    opened: list[Path],
) -> None:
    window, _ = live
    record(qtbot, window, tmp_path / "runs", frames=2)
    bar = window.recording_bar
    assert bar.folder is not None
    bar.report.click()
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(tmp_path / "out.csv"), ""))
    bar.exports.actions()[1].trigger()
    assert not bar.report.isEnabled()  # grey until it is written
    assert not bar.export.isEnabled()
    shown: set[str] = set()

    def is_written() -> bool:
        shown.add(bar.report.text())
        return "The report is in" in window.messages.log

    qtbot.waitUntil(is_written)
    assert "Report 80 %" in shown  # the pages are still to be drawn
    assert bar.report.text() == "Report"
    assert bar.report.isEnabled()
    assert opened == [bar.folder / "report.pdf"]
    assert (bar.folder / "report.pdf").read_bytes().startswith(b"%PDF")
    qtbot.waitUntil(lambda: "Exported to" in window.messages.log)
    assert len((tmp_path / "out.csv").read_text().splitlines()) == 3
    qtbot.waitUntil(lambda: not bar.findChildren(QProcess))


@pytest.mark.slow
@pytest.mark.long
def test_missing_viewer_is_named_in_the_window(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    record(qtbot, window, tmp_path, frames=2)
    monkeypatch.setattr(QDesktopServices, "openUrl", lambda _: False)
    window.recording_bar.open.click()
    window.update_text()
    assert window.messages.text.text().endswith("cannot be shown here: this desktop has no program for it")


@pytest.mark.slow
@pytest.mark.long
def test_failed_command_is_shown_until_dismissed(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, _ = live
    record(qtbot, window, tmp_path, frames=2)
    bar = window.recording_bar
    assert bar._finished is not None
    bar._finished.folder = tmp_path / "gone"
    bar.report.click()
    qtbot.waitUntil(lambda: "gone: no such folder" in window.messages.text.text())
    assert window.messages.dismiss.isVisible()
    assert bar.report.isEnabled()


@pytest.mark.slow
def test_replay_starts_another_window(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    record(qtbot, window, tmp_path, frames=2)
    started: list[tuple[str, list[str]]] = []

    def start(program: str, arguments: list[str]) -> tuple[bool, int]:
        started.append((program, arguments))
        return True, 1

    monkeypatch.setattr(QProcess, "startDetached", start)
    window.recording_bar.replay.click()
    qtbot.waitUntil(lambda: bool(started))
    ((program, arguments),) = started
    assert program == sys.executable
    assert arguments[-3:] == ["live", "--replay", str(window.recording_bar.folder)]


@pytest.mark.slow
def test_saved_seconds_and_recent_recordings(make_window: MakeWindow, qtbot: QtBot, tmp_path: Path) -> None:
    settings = QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat)
    window = make_window(FakeCamera(), saved=settings)
    window.connect_devices()
    window.recording_bar.recordings_folder = tmp_path / "runs"
    qtbot.waitUntil(lambda: window.controller.is_settled)
    qtbot.waitUntil(lambda: window.verdict.valid == "117 of 117")
    press(qtbot, window, Qt.Key.Key_K)
    qtbot.waitUntil(lambda: window.recording_bar.folder is not None)
    folder = window.recording_bar.folder
    assert folder is not None
    assert window.recording_bar.isVisible()
    assert RecentFiles(settings, "recent/recordings").paths() == (folder,)
    (menu,) = (each for each in window.findChildren(QMenu) if each.title() == "Replay a recent recording")
    menu.aboutToShow.emit()
    assert [action.text() for action in menu.actions()] == [folder.name]


@pytest.mark.slow
def test_recording_in_the_dark_is_announced(live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path) -> None:
    window, camera = live
    window.recording_bar.recordings_folder = tmp_path
    press(qtbot, window, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: not camera.light.shines and window.controls.light.text() == "Light off")
    press(qtbot, window, Qt.Key.Key_W)
    assert "Recording with the light off" in window.messages.log
    qtbot.waitUntil(lambda: window.recording_panel.record.text() == "Stop REC")
    assert window.controls.start.text() == "Stop"  # of the camera: another word
