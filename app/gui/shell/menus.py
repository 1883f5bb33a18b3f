"""Menus of the window, made of entries with their keys."""

from collections.abc import Mapping

from PyQt6.QtCore import Qt
from PyQt6.QtGui import QAction, QKeySequence
from PyQt6.QtWidgets import QAbstractButton, QMainWindow, QMenu

from app.gui.panels.panel import Entries

_EVERYWHERE = {"L"}  # keys that work in every dialog: the light


def fill_menus(window: QMainWindow, menus: Mapping[str, Entries]) -> None:
    """Fill the menu bar."""
    for title, entries in menus.items():
        if (bar := window.menuBar()) is not None and (menu := bar.addMenu(title)) is not None:
            _fill(menu, entries)


def _fill(menu: QMenu, entries: Entries) -> None:
    buttons: list[tuple[QAction, QAbstractButton]] = []
    for entry in entries:
        if entry is None:
            menu.addSeparator()
            continue
        text, key, act = entry
        if isinstance(act, QMenu):
            act.setTitle(text)
            menu.addMenu(act)
        elif (action := menu.addAction(text)) is not None:
            if isinstance(act, QAbstractButton):
                buttons.append((action, act))
                act = act.click
            action.setShortcut(QKeySequence(key))
            action.setAutoRepeat(False)  # a held key switches once
            if key in _EVERYWHERE:
                action.setShortcutContext(Qt.ShortcutContext.ApplicationShortcut)
            action.triggered.connect(lambda _=False, act=act: act())
    menu.aboutToShow.connect(lambda: _follow(buttons))
    menu.aboutToHide.connect(lambda: _enable(buttons))


def _follow(buttons: list[tuple[QAction, QAbstractButton]]) -> None:
    """Tick and grey the entries as their buttons."""
    for action, one in buttons:
        action.setEnabled(one.isEnabled() and not one.isHidden())
        action.setCheckable(one.isCheckable())
        action.setChecked(one.isChecked())


def _enable(buttons: list[tuple[QAction, QAbstractButton]]) -> None:
    """Enable the keys of a closed menu; a button refuses by itself."""
    for action, _ in buttons:
        action.setEnabled(True)
