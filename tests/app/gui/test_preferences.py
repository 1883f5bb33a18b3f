"""Preferences of the window, kept between starts."""

from __future__ import annotations

from pathlib import Path

import pytest
from PyQt6.QtCore import QSettings
from PyQt6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot

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
        assert PreferencesDialog(settings, parent).theme.currentText() == "Light"
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
