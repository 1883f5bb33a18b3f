"""State of the window: size, zoom, and what it remembers between two starts."""

from __future__ import annotations

from pathlib import Path

import pytest
from PyQt6.QtCore import QPoint, QRect, QSettings, Qt
from PyQt6.QtGui import QScreen
from PyQt6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from support.gui_bench import make_measurement
from support.window_tools import MakeWindow, dim_frame, press, views

from app.results.history import DELAY, RMS
from app.results.shown_wavefront import DisplayOptions, Unit
from app.results.view_maps import Quantity


@pytest.fixture
def settings(tmp_path: Path) -> QSettings:
    return QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat)


@pytest.fixture
def small_screen(monkeypatch: pytest.MonkeyPatch) -> QRect:
    """2560 x 1440 pixels at scale 2, with a panel along the top."""
    free = QRect(0, 30, 1280, 690)
    monkeypatch.setattr(QScreen, "availableGeometry", lambda _: free)
    return free


def test_window_opens_within_the_screen(make_window: MakeWindow, small_screen: QRect) -> None:
    window = make_window(resized=False)
    window.show_measurement(make_measurement(dim_frame(), views()))
    QApplication.processEvents()
    assert small_screen.contains(window.frameGeometry())
    for panel in (window.controls, window.status_line, window.recording_panel.record, window.panels.wavefronts.grid):
        place = QRect(panel.mapTo(window, QPoint()), panel.size())
        assert window.rect().contains(place)


def test_window_remembers_its_state(make_window: MakeWindow, settings: QSettings, tmp_path: Path) -> None:
    first = make_window(saved=settings)
    first.resize(1100, 700)  # wider than the screen of the tests
    first.panels.wavefronts.choice.setCurrentText(Quantity.UNCERTAINTY)
    first.panels.camera.arrows_toggle.setChecked(False)
    first.panels.camera.colours.setChecked(True)
    first.panels.camera.contrast.setCurrentText("Full range")
    menu = first.panels.wavefronts.menu
    for action in (menu.removed[5], menu.units[2], menu.grids[4], menu.averages[2]):
        action.trigger()
    first.panels.coefficients.basis.setCurrentText("Legendre")
    first.panels.history.minutes.setCurrentText("10 min")
    first.panels.history.toggles[DELAY].trigger()
    first.recording_bar.use_folder(tmp_path)
    QApplication.processEvents()
    first.close()
    second = make_window(saved=settings, resized=False)
    assert second.height() == 700
    assert second.panels.wavefronts.quantity is Quantity.UNCERTAINTY
    assert not second.panels.camera.arrows_toggle.isChecked()
    assert second.panels.camera.lattice_toggle.isChecked()
    assert second.panels.camera.colours.isChecked()
    assert second.panels.camera.contrast.currentText() == "Full range"
    assert second.panels.wavefronts.menu.options == DisplayOptions(frozenset({5}), views=4, averaged=5)
    assert second.panels.wavefronts.menu.unit is Unit.NM
    assert second.panels.wavefronts.menu.units[2].isChecked()
    assert second.panels.coefficients.basis.currentData() == "legendre"
    assert second.panels.history.minutes.currentData() == 10
    assert list(second.panels.history.charts) == [RMS, DELAY]
    assert second.recording_bar.recordings_folder == tmp_path


def test_damaged_or_outdated_state_is_ignored(make_window: MakeWindow, settings: QSettings, tmp_path: Path) -> None:
    settings.setValue("window/geometry", "nonsense")
    settings.setValue("view/quantity", "a quantity of another version")
    settings.setValue("folders/recordings", str(tmp_path / "removed"))
    window = make_window(saved=settings)
    assert window.panels.wavefronts.quantity is Quantity.WAVEFRONT
    assert window.recording_bar.recordings_folder == Path.home() / "svwfs"  # no cloud synchronises it
    window.close()
    assert settings.value("folders/recordings") == str(tmp_path / "removed")  # its disk may come back


def test_window_without_a_bench_says_how_to_open_one(make_window: MakeWindow) -> None:
    window = make_window()
    assert window.messages.text.text() == "No bench is open: open one (Ctrl+O), or a preset in the menu Bench"
    assert "Arrows" not in window.panels.camera.caption.text()
    assert not window.recording_panel.record.isEnabled()
    assert not window.recording_panel.keep.isEnabled()
    assert not window.controls.start.isEnabled()


def test_full_screen_and_back(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    press(qtbot, window, Qt.Key.Key_F11)
    assert window.isFullScreen()
    press(qtbot, window, Qt.Key.Key_F11)
    assert not window.isFullScreen()
