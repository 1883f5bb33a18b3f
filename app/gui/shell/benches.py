"""Benches in the window: opens files, recent ones and presets, and says what is wrong with one."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from PyQt6.QtCore import QObject, QSettings, QTimer, QUrl
from PyQt6.QtGui import QDesktopServices
from PyQt6.QtWidgets import QFileDialog, QMessageBox, QWidget

from app.bench.bench_files import faulty_lines
from app.bench.config import Bench, load_bench, save_bench
from app.bench.presets import DEFAULT, PRESETS
from app.bench.trusted_libraries import Library, named_libraries, trust, unconfirmed
from app.errors import InputError
from app.gui.panels.panel import Entries
from app.gui.shell.controller import Controller, SettingsControl
from app.gui.shell.menus import RecentFiles, listing_menu
from app.gui.shell.settings_dialog import BENCH_FILES, SettingsDialog, ask_bench_file
from app.gui.shell.status_text import as_sentence
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button
from app.gui.widgets.file_work import FileWork, answer

_LAST = "last/bench"  # key of the saved state

Choices = tuple[tuple[str, str, Callable[[], object]], ...]  # text, tool tip, action


class _Fault(NamedTuple):
    """Fault of a bench file, with the lines around it."""

    error: InputError
    path: Path | None
    line: int | None
    lines: tuple[tuple[int, str], ...]


class Benches(QObject):
    """Opens benches by `connect`; a faulty one leaves the open bench as it is."""

    def __init__(
        self,
        window: QWidget,
        connect: Callable[[Bench], object],
        controller: Controller,
        settings: SettingsControl,
        saved: QSettings | None,
    ) -> None:
        super().__init__(window)
        self._window, self._connect, self._messages = window, connect, controller.messages
        self._controller, self._settings, self._saved = controller, settings, saved
        self.recent = RecentFiles(saved, "recent/benches")
        self._reading = FileWork(self, self._messages.warn)  # also of libraries: a folder of them takes seconds
        self._saving = FileWork(self, self._messages.warn)
        self.dialog = BenchDialog(window)
        self.settings_dialog = SettingsDialog(self._use, self.open, window)
        self.error: InputError | None = None  # of the last attempt to open a bench
        self.name = ""  # of the open bench: its preset or its file

    def open(self, source: str, overrides: tuple[str, ...] = (), *, is_trusted: bool = False) -> None:
        """Open a bench file or a preset, changed by `overrides`; `is_trusted` confirms its libraries."""

        def connect(found: Bench | _Fault) -> None:
            if isinstance(found, _Fault):
                self.error = found.error
                self._explain(found, partial(self.open, source, overrides, is_trusted=is_trusted))
            else:
                self._connect_trusted(found, source, is_trusted=is_trusted)

        self.error = None
        self._reading.forget()  # another bench was to be opened
        self._reading.run(partial(_read, source, overrides), connect)

    def _connect_trusted(self, bench: Bench, source: str = "", *, is_trusted: bool = False) -> None:
        """Connect a bench, or ask first whether its libraries are trusted; `source` is its file, if any."""

        def connect(libraries: tuple[Library, ...]) -> None:
            if libraries:
                self._ask_to_trust(libraries, partial(self._connect_trusted, bench, source, is_trusted=True))
                return
            self.error = None
            if source and source not in PRESETS:
                self._remember(Path(source))
            self.name = Path(source).stem.replace("_", " ") if source else "unsaved bench"
            self._connect(bench)

        self._reading.forget()
        if not named_libraries(bench):
            connect(())
        else:
            self._reading.run(partial(_trust_libraries if is_trusted else unconfirmed, bench), connect)

    def _ask_to_trust(self, libraries: tuple[Library, ...], trusted: Callable[[], object]) -> None:
        named = "".join(f"<p><b>{library.key}</b> = {escape(library.named)}</p>" for library in libraries)
        self.error = InputError(f"{libraries[0].key} = {libraries[0].named} would run code and is not trusted")
        self.dialog.show_message(
            "Program library",
            f"<p>This bench runs the code of a program library. Open it only if you trust the library.</p>{named}",
            (("Trust and open", "Load it, now and later", trusted),),
        )

    def offer_last(self) -> None:
        """Ask whether to open the bench that was opened last, if it is a file that still exists."""
        name = None if self._saved is None else self._saved.value(_LAST)
        if isinstance(name, str) and name and answer(Path(name).is_file, otherwise=False):
            question = f'the bench "{Path(name).name}" was open last: open it again?'
            self._messages.ask(question, partial(self.open, name), "Open it", "Not now")

    def _remember(self, path: Path) -> None:
        self.recent.add(path)
        if self._saved is not None:
            self._saved.setValue(_LAST, str(path.absolute()))

    def edit(self, section: str = "sensor") -> None:
        """Edit the settings of the open bench, from a section on, with lattice, exposure and current in force."""
        status = self._controller.status
        self.settings_dialog.edit(load_bench(DEFAULT) if status is None else status.bench_in_force, section)

    def make(self) -> None:
        self.settings_dialog.make(replace(load_bench(DEFAULT), lattice=None))

    def _use(self, bench: Bench, before: Bench | None) -> None:
        """Connect a bench, unless it differs from the open one, `before`, only in the reconstruction."""
        changed: dict[str, Any] = {"registration": bench.registration, "reconstruction": bench.reconstruction}
        if before is None or self._controller.failure or replace(before, **changed) != bench:
            self._connect_trusted(bench)
        else:
            self._settings.change(*changed.items())

    def ask(self) -> None:
        folder = next((str(path.parent) for path in self.recent.paths()), "")
        name, _ = QFileDialog.getOpenFileName(self._window, "Open a bench", folder, BENCH_FILES)
        if name:
            self.open(name)

    def save(self) -> None:
        """Ask for a file and save the bench with the lattice and device settings in force."""
        status = self._controller.status
        path = None if status is None else ask_bench_file(self._window)
        if status is None or path is None:
            return

        def show(_: None) -> None:
            self.name = path.stem
            self._messages.inform(f"saved {path}")
            self._remember(path)

        self._saving.run(partial(save_bench, path, status.bench_in_force), show, writes=str(path))

    def menu_entries(self) -> Entries:
        text = "{0.name}  \N{EM DASH}  {0.parent}".format
        recent = self.recent.menu(self._window, text, lambda path: self.open(str(path)))
        presets = [(name.replace("_", " "), partial(self.open, name)) for name in PRESETS]
        return (
            ("Open a bench…", "Ctrl+O", self.ask),
            ("Open a recent bench", "", recent),
            ("Open a preset", "", listing_menu(self._window, lambda: presets)),
            ("New bench from my camera…", "Ctrl+N", self.make),
            ("Settings of the bench…", "Ctrl+,", self.edit),
            ("Save the bench…", "Ctrl+S", self.save),
        )

    def _explain(self, fault: _Fault, again: Callable[[], object]) -> None:
        error, path, line, lines = fault
        choices: Choices = (
            ("Try again", "Read the bench again, after you have corrected it", again),
            ("Open another…", "Choose another bench file (Ctrl+O)", self.ask),
        )
        if path is not None:
            url = QUrl.fromLocalFile(str(path.absolute()))  # opened in the program that the desktop has for it
            choices = (("Edit the file", f"Open {path}", lambda: QDesktopServices.openUrl(url)), *choices)
        place = "" if line is None else f"line {line}"
        title = ", ".join(filter(None, ("Faulty bench", place)))
        self.dialog.show_message(title, _fault_html(f"{error}{f' ({place})' if place else ''}", lines, line), choices)


def _read(source: str, overrides: tuple[str, ...]) -> Bench | _Fault:
    try:
        return load_bench(source, overrides)
    except InputError as error:
        return _Fault(error, *faulty_lines(source, error))


def _trust_libraries(bench: Bench) -> tuple[Library, ...]:
    """Confirm all libraries; none is left."""
    trust(named_libraries(bench))
    return ()


class BenchDialog(QMessageBox):
    """Shows one message with buttons that close it; the measurement continues meanwhile."""

    def show_message(self, title: str, html: str, choices: Choices) -> None:
        """Show a message; each button closes the dialog before it acts."""
        for button in self.buttons():
            self.removeButton(button)
            button.deleteLater()
        self.setWindowTitle(title)
        self.setText(html)
        for text, tool_tip, act in (*choices, ("Close", "Change nothing (Esc)", lambda: None)):
            button = Button(text, tool_tip, lambda _=False, act=act: QTimer.singleShot(0, act))
            self.addButton(button, QMessageBox.ButtonRole.ActionRole)
        self.setEscapeButton(button)
        self.setModal(False)
        self.show()
        self.activateWindow()


def _fault_html(sentence: str, lines: tuple[tuple[int, str], ...], faulty: int | None) -> str:
    """Format an error, and the lines of the file around the faulty one."""
    red = theme.RED.name()
    listing = "<br>".join(
        f'<span style="color: {red if number == faulty else theme.DIM.name()};">'
        f"{'&#9654;' if number == faulty else '&nbsp;'}&nbsp;{number:>4}&nbsp;&nbsp;"
        f"{escape(text).replace(' ', '&nbsp;')}</span>"
        for number, text in lines
    )
    shown = f"<p>{escape(as_sentence(sentence))}</p>"
    return f'{shown}<p style="font-family: monospace;">{listing}</p>' if lines else shown
