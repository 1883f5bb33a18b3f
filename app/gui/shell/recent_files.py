"""Recently used benches or recordings, newest first, remembered between starts."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from PyQt6.QtCore import QSettings
from PyQt6.QtWidgets import QMenu, QWidget

_MOST = 8


class RecentFiles:
    """A list of files or folders under one key of the settings."""

    def __init__(self, settings: QSettings | None, key: str) -> None:
        """Use what `settings` remember under `key`, such as "recent/benches"; without settings, only this session."""
        self._settings, self._key = settings, key
        self._names: list[str] = []

    def add(self, path: Path) -> None:
        """Put a path first."""
        absolute = path.absolute()
        paths = [absolute, *(one for one in self.paths() if one != absolute)]
        self._names = [str(one) for one in paths[:_MOST]]
        if self._settings is not None:
            self._settings.setValue(self._key, self._names)

    def paths(self) -> tuple[Path, ...]:
        """Return at most eight paths that exist, the newest first."""
        names: object = self._names if self._settings is None else self._settings.value(self._key)
        listed = [names] if isinstance(names, str) else names  # an INI file stores a list of one as text
        if not isinstance(listed, list):
            return ()
        return tuple(path for path in map(Path, filter(None, map(str, listed))) if path.exists())

    def menu(self, parent: QWidget, text: Callable[[Path], str], act: Callable[[Path], object]) -> QMenu:
        """Return a menu that lists the present paths and calls `act` with the chosen one."""
        return listing_menu(parent, lambda: [(text(path), partial(act, path)) for path in self.paths()])


def listing_menu(parent: QWidget, entries: Callable[[], Iterable[tuple[str, Callable[[], object]]]]) -> QMenu:
    """Return a menu whose `entries`, texts with what they do, are listed whenever it opens."""
    menu = QMenu(parent)

    def fill() -> None:
        menu.clear()
        for text, act in entries():
            menu.addAction(text, lambda _=False, act=act: act())
        if menu.isEmpty() and (none := menu.addAction("None yet")) is not None:
            none.setEnabled(False)

    menu.aboutToShow.connect(fill)
    return menu
