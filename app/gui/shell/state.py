"""State saved between two starts: geometry, panels, choices, limits, theme, and size of texts."""

from collections.abc import Mapping

from PyQt6.QtCore import QByteArray, QObject, QRect, QSettings
from PyQt6.QtGui import QActionGroup
from PyQt6.QtWidgets import QApplication, QComboBox, QDialog, QFormLayout, QMainWindow, QWidget

from app.gui.shell.docks import restore_docks
from app.gui.widgets import theme
from app.gui.widgets.buttons import Choice, close_button
from app.gui.widgets.layouts import FRAME_PX, fill_dialog, row, within_screen
from app.gui.widgets.texts import label

_LAYOUT = 2  # a state of another version is ignored
_THEME, _SIZE = "preferences/theme", "preferences/text"  # keys of the saved state
_USUAL = {_THEME: "system", _SIZE: "100"}
_SIZES = (80, 100, 125, 150)  # percent of the desktop's


def saved_state() -> QSettings:
    """Return what this user's window has saved."""
    return QSettings(QSettings.Format.IniFormat, QSettings.Scope.UserScope, "svwfs", "svwfs")


def _parts(window: QMainWindow) -> Mapping[str, QObject]:
    """Return what has a state, by its name: a key of the saved state."""
    return {name: part for part in window.findChildren(QObject) if "/" in (name := part.objectName())}


def save_state(saved: QSettings, window: QMainWindow) -> None:
    """Save the window and its parts: choices and ticks."""
    saved.setValue("window/geometry", window.saveGeometry())
    saved.setValue("window/panels", window.saveState(_LAYOUT))
    for key, part in _parts(window).items():
        saved.setValue(key, _state(part))
    saved.sync()


def restore_state(saved: QSettings, window: QMainWindow) -> bool:
    """Restore what was saved; return whether the panels have a saved layout."""
    if isinstance(geometry := saved.value("window/geometry"), QByteArray):
        window.restoreGeometry(geometry)
    panels = saved.value("window/panels")
    is_restored = isinstance(panels, QByteArray) and restore_docks(window, panels, _LAYOUT)
    for key, part in _parts(window).items():
        if saved.contains(key):
            _restore(part, str(saved.value(key)))  # an INI file stores text
    return is_restored


def fit_to_screen(window: QMainWindow) -> None:
    """Make the window, frame included, no larger than the free part of its screen, and move it there."""
    if (screen := window.screen()) is None or window.isMaximized() or window.isFullScreen():
        return
    if (layout := window.layout()) is not None:
        layout.activate()  # the default layout may have needed more
    free = screen.availableGeometry()
    window.resize(within_screen(window, window.size()))
    outer = QRect(window.pos(), window.size() + FRAME_PX)
    outer.moveRight(min(outer.right(), free.right()))
    outer.moveBottom(min(outer.bottom(), free.bottom()))
    window.move(max(outer.left(), free.left()), max(outer.top(), free.top()))


def _state(part: QObject) -> object:
    if isinstance(part, QActionGroup):
        return "" if (chosen := part.checkedAction()) is None else chosen.text()
    return part.property(_property(part))


def _restore(part: QObject, value: str) -> None:
    if isinstance(part, QActionGroup):
        for action in part.actions():
            if action.text() == value:
                action.trigger()
    else:
        part.setProperty(_property(part), value)  # ignored by a choice without such an item


def _property(part: QObject) -> str:
    """Return the property of Qt that holds the state of a choice or a tick."""
    return "currentText" if isinstance(part, QComboBox) else "checked"


def _preference(saved: QSettings, key: str) -> str:
    return str(saved.value(key, _USUAL[key]))


def apply_preferences(application: QApplication, saved: QSettings) -> None:
    """Use the saved theme and size; before a window is made, because its panels measure their texts."""
    theme.use_theme(application, _preference(saved, _THEME))
    font, size = application.font(), _preference(saved, _SIZE)
    if size.isdecimal() and int(size) in _SIZES:
        font.setPointSizeF(font.pointSizeF() * int(size) / 100)
        application.setFont(font)


class PreferencesDialog(QDialog):
    """Changes the theme at once, and the size from the next start on."""

    def __init__(self, saved: QSettings, parent: QWidget) -> None:
        super().__init__(parent)
        self._saved = saved
        self.setWindowTitle("Preferences")
        self.theme = Choice(items=(("As the desktop", "system"), ("Dark", "dark"), ("Light", "light")))
        self.size_choice = Choice(items=[(f"{percent} %", str(percent)) for percent in _SIZES])
        for choice, key in ((self.theme, _THEME), (self.size_choice, _SIZE)):
            choice.setCurrentIndex(choice.findData(_preference(saved, key)))
            choice.activated.connect(self._save)
        form = QFormLayout()
        form.addRow("Theme", self.theme)
        form.addRow("Size of texts", self.size_choice)
        form.addRow("", label("The size changes at the next start.", "dim"))
        fill_dialog(self, form, row((QWidget(), 1), close_button(self)))

    def _save(self) -> None:
        self._saved.setValue(_THEME, self.theme.currentData())
        self._saved.setValue(_SIZE, self.size_choice.currentData())
        application = QApplication.instance()
        if isinstance(application, QApplication):
            theme.use_theme(application, self.theme.currentData())
