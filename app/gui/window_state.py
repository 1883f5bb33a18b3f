"""State of the window between two starts: geometry, shown view and overlays, colours, and the recordings folder."""

from pathlib import Path

from PyQt6.QtCore import QByteArray, QObject, QRect, QSettings, QSize
from PyQt6.QtWidgets import QAbstractButton, QComboBox, QMainWindow, QWidget

_LAYOUT = 1  # changes with the set of panels; a state of another layout is ignored
_FRAME = QSize(10, 40)  # px; window managers add it only when the window is shown


def settings_file() -> QSettings:
    """Return the user's settings of this program."""
    return QSettings(QSettings.Format.IniFormat, QSettings.Scope.UserScope, "svwfs", "svwfs")


def save_state(settings: QSettings, window: QMainWindow, parts: dict[str, QObject], recordings_folder: Path) -> None:
    """Save the window and its parts: panels, choices, toggles, and widgets that can be hidden, by their keys."""
    settings.setValue("window/geometry", window.saveGeometry())
    settings.setValue("window/panels", window.saveState(_LAYOUT))
    settings.setValue("folders/recordings", str(recordings_folder))
    for key, part in parts.items():
        settings.setValue(key, _state(part))
    settings.sync()


def restore_state(settings: QSettings, window: QMainWindow, parts: dict[str, QObject]) -> Path | None:
    """Restore what was saved; return the recordings folder if it still exists."""
    if isinstance(geometry := settings.value("window/geometry"), QByteArray):
        window.restoreGeometry(geometry)
    if isinstance(panels := settings.value("window/panels"), QByteArray):
        window.restoreState(panels, _LAYOUT)
    for key, part in parts.items():
        if settings.contains(key):
            _restore(part, settings.value(key))
    folder = settings.value("folders/recordings")
    return Path(folder) if isinstance(folder, str) and Path(folder).is_dir() else None


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


def _state(part: QObject) -> object:
    match part:
        case QComboBox():
            return part.currentText()
        case QAbstractButton():
            return int(part.isChecked())
        case QWidget():
            return int(not part.isHidden())
    raise TypeError(f"{type(part).__name__} has no state to save")


def _restore(part: QObject, value: object) -> None:
    is_on = str(value) == "1"  # an INI file stores text
    match part:
        case QComboBox():
            part.setCurrentText(str(value))  # ignored if there is no such item
        case QAbstractButton():
            part.setChecked(is_on)
        case QWidget():
            part.setVisible(is_on)
