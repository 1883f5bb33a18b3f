"""Recordings, benches and frames dropped on the window."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from PyQt6.QtCore import QMimeData, QPoint, QPointF, Qt, QUrl
from PyQt6.QtGui import QAction, QDragEnterEvent, QDragMoveEvent, QDropEvent
from PyQt6.QtWidgets import QApplication, QFileDialog
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.records import make_record, write
from support.window_tools import press

from app.gui.shell.main_window import MainWindow


def drop(window: MainWindow, *paths: Path) -> None:
    data = QMimeData()
    data.setUrls([QUrl.fromLocalFile(str(path)) for path in paths])
    button, keys, copy = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier, Qt.DropAction.CopyAction
    for event in (
        QDragEnterEvent(QPoint(50, 50), copy, data, button, keys),
        QDropEvent(QPointF(50, 50), copy, data, button, keys),
    ):
        QApplication.sendEvent(window, event)
        assert event.isAccepted()


@pytest.mark.slow
def test_recording_opens_another_window(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    started: list[Path] = []
    monkeypatch.setattr(window.recording_bar, "_start_window", started.append)
    write(tmp_path / "run", [make_record(0)])
    drop(window, tmp_path / "run")
    qtbot.waitUntil(lambda: started == [tmp_path / "run"])
    (tmp_path / "photos").mkdir()
    drop(window, tmp_path / "photos")
    qtbot.waitUntil(lambda: "holds no recording" in window.messages.log)
    assert len(started) == 1


@pytest.mark.slow
def test_dragging_across_opens_nothing(
    live: tuple[MainWindow, FakeCamera], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A move event is also a `QDropEvent` in Qt."""
    window, _ = live
    opened: list[Path] = []
    monkeypatch.setattr(window, "open_file", opened.append)
    data = QMimeData()
    data.setUrls([QUrl.fromLocalFile(str(tmp_path))])
    for kind in (QDragEnterEvent, QDragMoveEvent, QDragMoveEvent):
        copy, button, keys = Qt.DropAction.CopyAction, Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
        event = kind(QPoint(50, 50), copy, data, button, keys)
        QApplication.sendEvent(window, event)
        assert event.isAccepted()
    assert not opened
    drop(window, tmp_path)
    assert opened == [tmp_path]


@pytest.mark.slow
def test_source_that_proposes_a_move_is_told_of_a_copy(
    live: tuple[MainWindow, FakeCamera], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else it may delete what was dropped."""
    window, _ = live
    monkeypatch.setattr(window, "open_file", lambda _: None)
    data = QMimeData()
    data.setUrls([QUrl.fromLocalFile(str(tmp_path))])
    both = Qt.DropAction.MoveAction | Qt.DropAction.CopyAction
    button, keys = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.ShiftModifier
    for event in (
        QDragEnterEvent(QPoint(50, 50), both, data, button, keys),
        QDragMoveEvent(QPoint(50, 50), both, data, button, keys),
        QDropEvent(QPointF(50, 50), both, data, button, keys),
    ):
        event.setDropAction(Qt.DropAction.MoveAction)
        QApplication.sendEvent(window, event)
        assert event.isAccepted()
        assert event.dropAction() == Qt.DropAction.CopyAction


@pytest.mark.slow
def test_bench_is_opened(live: tuple[MainWindow, FakeCamera], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    window, _ = live
    asked: list[str] = []
    monkeypatch.setattr(window.benches, "open", asked.append)
    path = tmp_path / "mine.toml"
    path.write_text("")
    drop(window, path)
    assert asked == [str(path)]


@pytest.mark.slow
@pytest.mark.parametrize("is_dropped", [True, False])
def test_frame_is_reconstructed_until_the_camera_starts(
    live: tuple[MainWindow, FakeCamera],
    qtbot: QtBot,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    is_dropped: bool,
) -> None:
    """The reference frame, brightened: the wavefront is flat."""
    window, camera = live
    assert window.controller.acquisition is not None
    reference = 500 + 40000 * camera._images[0]
    tifffile.imwrite(tmp_path / "flat.tif", np.rint(reference).astype(np.uint16))
    if is_dropped:
        drop(window, tmp_path / "flat.tif")
    else:
        monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(tmp_path / "flat.tif"), ""))
        next(each for each in window.findChildren(QAction) if each.text() == "Open a frame…").trigger()
    qtbot.waitUntil(lambda: window.panels.camera.badge.text() == "FILE flat.tif")
    assert not window.verdict.text().startswith("GOOD")
    newest = window.controller.acquisition.newest
    assert newest is not None
    np.testing.assert_array_equal(newest.frame.pixels, np.rint(reference).astype(np.uint16))
    assert newest.wavefront is not None
    assert np.nanmax(np.abs(newest.wavefront.views)) < 0.1
    assert abs(newest.latency_s) < 60
    qtbot.waitUntil(lambda: window.controls.start.text() == "Start")
    press(qtbot, window, Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: window.controller.acquisition.newest is not newest)  # type: ignore[union-attr] # it is live


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("pixels", "problem"),
    [
        (np.zeros((30, 40), np.uint16), "has 30 x 40 pixels, the camera's frames 300 x 430"),
        (np.full((300, 430), -1.0), "no counts from 0 to 65535"),
        (np.full((300, 430), np.nan), "no counts from 0 to 65535"),
    ],
)
def test_unusable_frame_is_refused(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, pixels: np.ndarray, problem: str
) -> None:
    window, camera = live
    np.save(tmp_path / "frame.npy", pixels)
    drop(window, tmp_path / "frame.npy")
    qtbot.waitUntil(lambda: problem in window.messages.log)
    assert camera.state == "running"  # nothing was shown instead
    assert not window.controller.failure


@pytest.mark.slow
def test_frame_is_refused_during_a_recording(live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path) -> None:
    window, _ = live
    window.recording_bar.recordings_folder = tmp_path / "runs"
    press(qtbot, window, Qt.Key.Key_W)
    qtbot.waitUntil(lambda: window.recording_panel.record.text() == "Stop REC")
    np.save(tmp_path / "frame.npy", np.zeros((300, 430), np.uint16))
    drop(window, tmp_path / "frame.npy")
    qtbot.waitUntil(lambda: "is not shown during a recording" in window.messages.log)


@pytest.mark.slow
def test_other_files_are_refused(live: tuple[MainWindow, FakeCamera], tmp_path: Path) -> None:
    window, _ = live
    (tmp_path / "notes.txt").write_text("x")
    drop(window, tmp_path / "notes.txt")
    assert "  notes.txt: drop a recording's folder" in window.messages.log
