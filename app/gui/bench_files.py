"""Benches in the window: opens files, recent ones and presets, and says what is wrong with one."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

from PyQt6.QtCore import QObject, QSettings, QUrl
from PyQt6.QtGui import QDesktopServices
from PyQt6.QtWidgets import QFileDialog, QMenu, QWidget

from app.bench.bench_files import BenchError, bench_file, excerpt, read_bench_text
from app.bench.config import Bench, load_bench
from app.bench.presets import PRESETS
from app.bench.trusted_libraries import unconfirmed
from app.errors import InputError
from app.gui.bench_dialog import BenchDialog, Choices, fault_html
from app.gui.controller import Controller
from app.gui.recent_files import RecentFiles
from app.gui.settings_dialog import SettingsDialog

_TEMPLATE = "live_demo"
_FILES = "Bench (*.toml)"
_LAST = "last/bench"  # key of the settings


class BenchFiles(QObject):
    """Opens benches by `connect`; a faulty one leaves the open bench as it is."""

    def __init__(
        self, window: QWidget, connect: Callable[[Bench], object], controller: Controller, settings: QSettings | None
    ) -> None:
        """`settings` remember the recent benches and the last one."""
        super().__init__(window)
        self._window, self._connect, self._controller, self.remembered = window, connect, controller, settings
        self.recent = RecentFiles(settings, "recent/benches")
        self.dialog = BenchDialog(window)
        self.settings: SettingsDialog | None = None  # made when it is needed
        self.error: InputError | None = None  # of the last attempt to open a bench

    def open(self, source: str, overrides: tuple[str, ...] = (), *, trust: bool = False) -> None:
        """Open a bench file or a preset, changed by `overrides`; `trust` confirms the libraries that it names."""
        self.error = None
        try:
            bench = load_bench(source, overrides)
        except InputError as error:
            self.error = error
            self._explain(source, overrides, error)
            return
        self._connect_trusted(bench, source, trust=trust)

    def _connect_trusted(self, bench: Bench, source: str, *, trust: bool = False) -> None:
        """Connect a bench, or ask first whether its libraries are trusted; `source` is empty without a file."""
        if (libraries := unconfirmed(bench)) and not trust:
            named = "".join(f"<p><b>{library.key}</b> = {escape(library.named)}</p>" for library in libraries)
            self.error = InputError(f"{libraries[0].key} = {libraries[0].named} would run code and is not trusted")
            self.dialog.show_message(
                "Program library",
                f"<p>This bench runs the code of a program library. Open it only if you trust the library.</p>{named}",
                (
                    (
                        "Trust and open",
                        "Load it, now and later",
                        partial(self._connect_trusted, bench, source, trust=True),
                    ),
                ),
            )
            return
        for library in libraries:
            library.trust()
        self.error = None
        if source and source not in PRESETS:
            self.recent.add(Path(source))
            self._remember(Path(source))
        self._connect(bench)

    def offer_last(self) -> None:
        """Ask whether to open the bench that was opened last, if it is a file that still exists."""
        name = None if self.remembered is None else self.remembered.value(_LAST)
        if isinstance(name, str) and name and Path(name).is_file():
            question = f'the bench "{Path(name).name}" was open last: open it again?'
            self._controller.ask(question, partial(self.open, name), "Open it", "Not now")

    def _remember(self, path: Path) -> None:
        if self.remembered is not None:
            self.remembered.setValue(_LAST, str(path.absolute()))

    def edit(self) -> None:
        """Edit the settings of the open bench, with lattice, exposure and current in force."""
        status = self._controller.status
        self._settings().edit(load_bench(_TEMPLATE) if status is None else status.bench_in_force)

    def make(self) -> None:
        """Make a bench with connected devices."""
        self._settings().make(replace(load_bench(_TEMPLATE), lattice=None))

    def _settings(self) -> SettingsDialog:
        if self.settings is None:
            self.settings = SettingsDialog(self._use, self.open, self._window)
        return self.settings

    def _use(self, bench: Bench, before: Bench | None) -> None:
        """Connect the devices of a bench, unless it differs from the open one, `before`, in the reconstruction only."""
        changed: dict[str, Any] = {"registration": bench.registration, "reconstruction": bench.reconstruction}
        if before is None or self._controller.failure or replace(before, **changed) != bench:
            self._connect_trusted(bench, source="")
        else:
            self._controller.settings.change(*changed.items())

    def ask(self) -> None:
        """Ask for a bench file, and open it."""
        folder = next((str(path.parent) for path in self.recent.paths()), "")
        name, _ = QFileDialog.getOpenFileName(self._window, "Open a bench", folder, _FILES)
        if name:
            self.open(name)

    def save(self) -> None:
        """Ask for a file and save the bench in force."""
        if self._controller.status is None:
            return
        name, _ = QFileDialog.getSaveFileName(self._window, "Save the bench", "bench.toml", _FILES)
        if name and self._controller.save_bench(Path(name)):
            self.recent.add(Path(name))
            self._remember(Path(name))

    def recent_menu(self) -> QMenu:
        """Make the menu of the recent benches."""
        return self._menu(self._recent_entries)

    def presets_menu(self) -> QMenu:
        """Make the menu of the presets."""
        return self._menu(lambda: tuple((name.replace("_", " "), name) for name in PRESETS))

    def _menu(self, entries: Callable[[], tuple[tuple[str, str], ...]]) -> QMenu:
        menu = QMenu(self._window)
        menu.aboutToShow.connect(lambda: self._list(menu, entries))
        return menu

    def _list(self, menu: QMenu, entries: Callable[[], tuple[tuple[str, str], ...]]) -> None:
        menu.clear()
        for text, source in entries():
            if (action := menu.addAction(text)) is not None:
                action.triggered.connect(lambda _=False, source=source: self.open(source))
        if menu.isEmpty() and (none := menu.addAction("None yet")) is not None:
            none.setEnabled(False)

    def _recent_entries(self) -> tuple[tuple[str, str], ...]:
        return tuple((f"{path.name}  \N{EM DASH}  {path.parent}", str(path)) for path in self.recent.paths())

    def _explain(self, source: str, overrides: tuple[str, ...], error: InputError) -> None:
        line = error.line if isinstance(error, BenchError) else None
        choices: Choices = (
            ("Try again", "Read the bench again, after you have corrected it", lambda: self.open(source, overrides)),
            ("Open another \N{HORIZONTAL ELLIPSIS}", "Choose another bench file (Ctrl+O)", self.ask),
        )
        lines: tuple[tuple[int, str], ...] = ()
        try:
            path = bench_file(source)
            lines = () if line is None else excerpt(read_bench_text(path), line)
        except InputError:
            pass  # there is no such file
        else:
            choices = (("Edit the file", f"Open {path}", lambda: _edit(path)), *choices)
        place = "" if line is None else f", line {line}"
        self.dialog.show_message(
            f"Faulty bench{place}", fault_html(f"{error}{place and f' ({place[2:]})'}", lines, line), choices
        )


def _edit(path: Path) -> None:
    """Open a file in the program that the desktop has for it."""
    QDesktopServices.openUrl(QUrl.fromLocalFile(str(path.absolute())))
