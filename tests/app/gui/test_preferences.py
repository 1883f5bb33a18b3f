"""Preferences of the window, and presets of the devices: kept between starts."""

from __future__ import annotations

from pathlib import Path

import pytest
from PyQt6.QtCore import QSettings
from PyQt6.QtGui import QAction
from PyQt6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import MakeWindow, wait_for_wavefront

from app.acquisition.commands import Commands
from app.gui.shell.device_dialogs import DevicePresets
from app.gui.shell.main_window import MainWindow
from app.gui.shell.state import PreferencesDialog, apply_preferences
from app.gui.widgets import theme


@pytest.fixture
def settings(tmp_path: Path) -> QSettings:
    return QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat)


@pytest.mark.usefixtures("restored_theme")
def test_theme_changes_at_once_and_is_kept(qapp: QApplication, qtbot: QtBot, settings: QSettings) -> None:
    theme.styled_application()
    parent = QWidget()
    qtbot.addWidget(parent)
    dialog = PreferencesDialog(settings, parent)
    try:
        for name, text in (("light", "#1b2026"), ("dark", "#dde2e8")):
            dialog.theme.setCurrentIndex(dialog.theme.findData(name))
            dialog.theme.activated.emit(dialog.theme.currentIndex())
            assert theme.TEXT.name() == text
        dialog.theme.setCurrentIndex(dialog.theme.findData("light"))
        dialog.theme.activated.emit(2)
        theme.use_theme(qapp, "dark")
        apply_preferences(qapp, settings)  # the next start
        assert theme.TEXT.name() == "#1b2026"
        assert PreferencesDialog(settings, parent).theme.currentText() == "light"
    finally:
        qapp.setProperty("theme", None)


@pytest.mark.usefixtures("restored_theme")
def test_size_of_texts_changes_at_the_next_start(qapp: QApplication, qtbot: QtBot, settings: QSettings) -> None:
    parent = QWidget()
    qtbot.addWidget(parent)
    dialog, usual = PreferencesDialog(settings, parent), qapp.font()
    dialog.size_choice.setCurrentText("125 %")
    dialog.size_choice.activated.emit(2)
    assert qapp.font() == usual
    try:
        apply_preferences(qapp, settings)
        assert qapp.font().pointSizeF() == pytest.approx(1.25 * usual.pointSizeF())
        settings.setValue("preferences/text", "1e9")  # edited by hand
        qapp.setFont(usual)
        apply_preferences(qapp, settings)
        assert qapp.font() == usual
    finally:
        qapp.setFont(usual)


def presets_of(window: MainWindow) -> DevicePresets:
    (action,) = [one for one in window.findChildren(QAction) if one.text() == "Presets of exposure and mask"]
    action.trigger()
    (dialog,) = window.findChildren(DevicePresets)
    return dialog


@pytest.mark.slow
@pytest.mark.long
def test_preset_restores_exposure_and_mask_also_after_a_restart(
    make_window: MakeWindow, qtbot: QtBot, settings: QSettings
) -> None:
    camera = FakeCamera()
    window = make_window(camera, saved=settings)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    dialog = presets_of(window)
    dialog.save.click()  # without a name
    assert not dialog.names.count()
    dialog.name.setText("cells")
    dialog.save.click()
    window.controls.wanted.emit(Commands.set_exposure_s, 0.03)
    window.controls.wanted.emit("mask", "stars")
    qtbot.waitUntil(lambda: camera.exposure_s == 0.03 and camera.stage.mask == "stars")
    again = DevicePresets(window.controller, window.controls, settings, window)
    qtbot.waitUntil(lambda: window.controller.is_settled)
    again.names.setCurrentRow(0)
    again.apply.click()
    qtbot.waitUntil(lambda: camera.exposure_s == 0.02 and camera.stage.mask == "square")
    again.delete.click()
    assert not again.names.count()
    for text in ("no JSON", '{"a": 1}', '{"a": {"current_a": "x"}}', "[1]"):  # edited by hand
        settings.setValue("presets/devices", text)
        assert not DevicePresets(window.controller, window.controls, settings, window).names.count()


def test_empty_presets_are_explained_and_offer_nothing(make_window: MakeWindow, settings: QSettings) -> None:
    window = make_window(saved=settings)
    dialog = presets_of(window)
    assert dialog.about.text().startswith("There are no presets yet. ")
    assert not any(button.isEnabled() for button in (dialog.save, dialog.apply, dialog.delete))
    title = dialog.fontMetrics().horizontalAdvance(dialog.windowTitle())
    assert dialog.width() > title + 120  # beside the buttons of a window manager
    settings.setValue("presets/devices", '{"cells": {"exposure_s": 0.03}}')
    again = DevicePresets(window.controller, window.controls, settings, window)
    assert not again.about.text().startswith("There are no")
    assert not again.delete.isEnabled()
    again.names.setCurrentRow(0)
    assert again.delete.isEnabled()
    assert not again.apply.isEnabled()  # no bench is open
