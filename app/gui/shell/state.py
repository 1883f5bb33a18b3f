"""State of the window between two starts: geometry, panels, choices and toggles."""

from collections.abc import Mapping

from PyQt6.QtCore import QByteArray, QObject, QRect, QSettings, QSize
from PyQt6.QtGui import QAction, QActionGroup
from PyQt6.QtWidgets import QAbstractButton, QComboBox, QMainWindow, QWidget

_LAYOUT = 1  # a state of another version is ignored
_FRAME = QSize(10, 40)  # px; window managers add it only when the window is shown

Parts = Mapping[str, QObject | None]  # what has a state, by the keys of the settings


def settings_file() -> QSettings:
    """Return the user's settings of this program."""
    return QSettings(QSettings.Format.IniFormat, QSettings.Scope.UserScope, "svwfs", "svwfs")


def save_state(settings: QSettings, window: QMainWindow, parts: Parts) -> None:
    """Save the window and its parts: choices, toggles, and widgets that can be hidden."""
    settings.setValue("window/geometry", window.saveGeometry())
    settings.setValue("window/panels", window.saveState(_LAYOUT))
    for key, part in parts.items():
        settings.setValue(key, _state(part))
    settings.sync()


def restore_state(settings: QSettings, window: QMainWindow, parts: Parts) -> None:
    """Restore what was saved."""
    if isinstance(geometry := settings.value("window/geometry"), QByteArray):
        window.restoreGeometry(geometry)
    if isinstance(panels := settings.value("window/panels"), QByteArray):
        window.restoreState(panels, _LAYOUT)
    for key, part in parts.items():
        if settings.contains(key):
            _restore(part, str(settings.value(key)))  # an INI file stores text


def fit_to_screen(window: QMainWindow) -> None:
    """Make the window, frame included, no larger than the free part of its screen, and move it there."""
    if (screen := window.screen()) is None or window.isMaximized() or window.isFullScreen():
        return
    free = screen.availableGeometry()
    window.resize(window.size().boundedTo(free.size() - _FRAME))
    outer = QRect(window.pos(), window.size() + _FRAME)
    outer.moveRight(min(outer.right(), free.right()))
    outer.moveBottom(min(outer.bottom(), free.bottom()))
    window.move(max(outer.left(), free.left()), max(outer.top(), free.top()))


def _state(part: QObject | None) -> object:
    match part:
        case QActionGroup():
            return "" if (chosen := part.checkedAction()) is None else chosen.text()
        case QComboBox():
            return part.currentText()
        case QAction() | QAbstractButton():
            return int(part.isChecked())
        case QWidget():
            return int(not part.isHidden())
    raise TypeError(f"{type(part).__name__} has no state to save")


def _restore(part: QObject | None, value: str) -> None:
    is_on = value == "1"
    match part:
        case QActionGroup():
            for action in part.actions():
                if action.text() == value:
                    action.trigger()
        case QComboBox():
            part.setCurrentText(value)  # ignored if there is no such item
        case QAction() | QAbstractButton():
            part.setChecked(is_on)
        case QWidget():
            part.setVisible(is_on)
