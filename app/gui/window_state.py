"""State of the window between two starts: geometry, display options, colours, and the recordings folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from PyQt6.QtCore import QByteArray, QObject, QRect, QSettings, QSize
from PyQt6.QtGui import QAction, QActionGroup
from PyQt6.QtWidgets import QAbstractButton, QComboBox, QMainWindow, QWidget

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow

_LAYOUT = 1  # changes with the set of panels; a state of another layout is ignored
_FRAME = QSize(10, 40)  # px; window managers add it only when the window is shown


def settings_file() -> QSettings:
    """Return the user's settings of this program."""
    return QSettings(QSettings.Format.IniFormat, QSettings.Scope.UserScope, "svwfs", "svwfs")


def save_state(settings: QSettings, window: MainWindow) -> None:
    """Save the window and its parts: panels, choices, toggles, and widgets that can be hidden."""
    settings.setValue("window/geometry", window.saveGeometry())
    settings.setValue("window/panels", window.saveState(_LAYOUT))
    settings.setValue("folders/recordings", str(window.controller.recordings_folder))
    for key, part in _parts(window).items():
        settings.setValue(key, _state(part))
    settings.sync()


def restore_state(settings: QSettings, window: MainWindow) -> None:
    """Restore what was saved; the recordings folder only if it still exists."""
    if isinstance(geometry := settings.value("window/geometry"), QByteArray):
        window.restoreGeometry(geometry)
    if isinstance(panels := settings.value("window/panels"), QByteArray):
        window.restoreState(panels, _LAYOUT)
    for key, part in _parts(window).items():
        if settings.contains(key):
            _restore(part, str(settings.value(key)))  # an INI file stores text
    folder = settings.value("folders/recordings")
    if isinstance(folder, str) and Path(folder).is_dir():
        window.controller.recordings_folder = Path(folder)


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


def _parts(window: MainWindow) -> Mapping[str, QObject | None]:
    """Return what has a state, by the keys of the settings."""
    camera, wavefront, menu, tabs = (
        window.camera_panel,
        window.wavefront_panel,
        window.wavefront_panel.menu,
        window.tabs,
    )
    return {
        "window/times": window.status_line.timing_row,
        "camera/lattice": camera.lattice_toggle,
        "camera/arrows": camera.arrows_toggle,
        "camera/contrast": camera.contrast,
        "camera/colours": camera.colours,
        "view/quantity": wavefront.choice,
        "view/tilt": menu.tilt,
        "view/defocus": menu.defocus,
        "view/average": menu.averages[0].actionGroup(),
        "view/unit": menu.units[0].actionGroup(),
        "view/grid": menu.grids[0].actionGroup(),
        "coefficients/basis": tabs.coefficients.basis,
        "history/minutes": tabs.history.minutes,
        "history/samples": tabs.history.samples,
        **{f"history/chart {index}": toggle for index, toggle in enumerate(tabs.history.toggles.values())},
    }


def _state(part: QObject | None) -> object:
    match part:
        case QActionGroup():
            return "" if (chosen := part.checkedAction()) is None else chosen.text()
        case QAction():
            return int(part.isChecked())
        case QComboBox():
            return part.currentText()
        case QAbstractButton():
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
        case QAction():
            part.setChecked(is_on)
        case QComboBox():
            part.setCurrentText(value)  # ignored if there is no such item
        case QAbstractButton():
            part.setChecked(is_on)
        case QWidget():
            part.setVisible(is_on)
