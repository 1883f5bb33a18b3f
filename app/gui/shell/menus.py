"""Menus of the window, made of entries with their keys, or of the files used last."""

import string
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path

from PyQt6.QtCore import QSettings, Qt
from PyQt6.QtGui import QAction, QKeySequence
from PyQt6.QtWidgets import QAbstractButton, QMenu, QMenuBar, QWidget

from app.gui.panels.panel import Entries
from app.gui.widgets.file_work import answer

_MOST = 8  # recent files
_EVERYWHERE = {"L", "F12"}  # keys that work in every dialog: the light
_PLAIN = {*string.ascii_uppercase, "Space"} - _EVERYWHERE  # keys that may be typed by mistake
_COMMANDS = {"&File", "&Bench"}  # menus that change the instrument, not only the display


def fill_menus(bar: QMenuBar, menus: Mapping[str, Entries], ask: Callable[[str, Callable[[], object]], object]) -> None:
    """Fill the menu bar; `ask` gets text and action of what a plain key would do with the instrument."""
    for title, entries in menus.items():
        if (menu := bar.addMenu(title)) is not None:
            _fill(menu, entries, ask if title in _COMMANDS else lambda _, act: act())


def _fill(menu: QMenu, entries: Entries, ask: Callable[[str, Callable[[], object]], object]) -> None:
    buttons: list[tuple[QAction, QAbstractButton]] = []
    for entry in entries:
        if entry is None:
            menu.addSeparator()
            continue
        text, key, act = entry
        if isinstance(act, QMenu):
            act.setTitle(text)
            menu.addMenu(act)
        elif isinstance(act, QAction):
            act.setShortcut(QKeySequence(key))
            act.setAutoRepeat(False)
            menu.addAction(act)
        elif (action := menu.addAction(text)) is not None:
            if isinstance(act, QAbstractButton):
                buttons.append((action, act))
                act = act.click
            action.setShortcut(QKeySequence(key))
            action.setAutoRepeat(False)  # a held key switches once
            if key in _EVERYWHERE:
                action.setShortcutContext(Qt.ShortcutContext.ApplicationShortcut)
            if key in _PLAIN:
                act = partial(ask, text.rstrip("…"), act)
            action.triggered.connect(lambda _=False, act=act: act())
    menu.aboutToShow.connect(lambda: _follow(buttons, is_open=True))
    menu.aboutToHide.connect(lambda: _follow(buttons, is_open=False))


def _follow(buttons: list[tuple[QAction, QAbstractButton]], *, is_open: bool) -> None:
    """Tick and grey the entries of an open menu as their buttons; the keys of a closed one always work."""
    for action, one in buttons:
        action.setEnabled(not is_open or (one.isEnabled() and not one.isHidden()))
        action.setCheckable(one.isCheckable())
        action.setChecked(one.isChecked())


class RecentFiles:
    """A list of files or folders under one key of the saved state."""

    def __init__(self, saved: QSettings | None, key: str) -> None:
        """Use what is `saved` under `key`, such as "recent/benches"; None remembers only this session."""
        self._saved, self._key = saved, key
        self._names: list[str] = []

    def add(self, path: Path) -> None:
        absolute = path.absolute()
        paths = [absolute, *(one for one in self.paths() if one != absolute)]
        self._names = [str(one) for one in paths[:_MOST]]
        if self._saved is not None:
            self._saved.setValue(self._key, self._names)

    def paths(self) -> tuple[Path, ...]:
        """Return at most eight paths that exist, the newest first; all, if a disk does not answer."""
        names: object = self._names if self._saved is None else self._saved.value(self._key)
        listed = [names] if isinstance(names, str) else names  # an INI file stores a list of one as text
        if not isinstance(listed, list):
            return ()
        paths = tuple(map(Path, filter(None, map(str, listed))))
        return answer(lambda: tuple(path for path in paths if path.exists()), otherwise=paths)

    def menu(self, parent: QWidget, text: Callable[[Path], str], act: Callable[[Path], object]) -> QMenu:
        """Return a menu that lists the present paths and calls `act` with the chosen one."""
        return listing_menu(parent, lambda: [(text(path), partial(act, path)) for path in self.paths()])


def listing_menu(parent: QWidget, entries: Callable[[], Iterable[QAction | tuple[str, Callable[[], object]]]]) -> QMenu:
    """Return a menu whose `entries`, actions or texts with what they do, are listed whenever it opens."""
    menu = QMenu(parent)

    def fill() -> None:
        menu.clear()
        for entry in entries():
            if isinstance(entry, QAction):
                menu.addAction(entry)
            else:
                menu.addAction(entry[0], lambda _=False, act=entry[1]: act())
        if menu.isEmpty() and (none := menu.addAction("None yet")) is not None:
            none.setEnabled(False)

    menu.aboutToShow.connect(fill)
    return menu
