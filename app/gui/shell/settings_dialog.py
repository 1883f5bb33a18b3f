"""Form for all settings of a bench, also for a new one with connected devices."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from PyQt6.QtCore import QSize
from PyQt6.QtWidgets import QCheckBox, QDialog, QFormLayout, QLineEdit, QListWidget, QStackedWidget, QWidget

from app.bench.config import Bench, save_bench
from app.bench.device_kinds import KINDS
from app.bench.settings_form import NAMES, FormField, SettingsForm, fault_in_words, fault_path, name_of
from app.errors import InputError
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button, Choice, close_button
from app.gui.widgets.copies import ask_file
from app.gui.widgets.file_work import FileWork
from app.gui.widgets.layouts import Scrolled, fill_dialog, row, within_screen
from app.gui.widgets.texts import ElidedLabel, colour_text, label, mark_refused
from drivers.device import DiscoveredDevice

_DETAIL = re.compile(r" \(.*?\)(?=:)")  # of an error, before the advice: a system's words, in its language
BENCH_FILES = "Bench (*.toml)"  # of a dialog
_NO_DEVICE = "Other, or simulated: choose the driver below"


class SettingsDialog(QDialog):
    """Edits a form; calls `use(new_bench, old_bench)`, and `opened(file)` when a bench was saved."""

    def __init__(
        self, use: Callable[[Bench, Bench | None], object], opened: Callable[[str], object], parent: QWidget
    ) -> None:
        super().__init__(parent)
        self.resize(within_screen(self, QSize(52, 34) * self.fontMetrics().height()))
        self._use, self._opened = use, opened
        self._form = SettingsForm({})
        self._before: Bench | None = None  # the edited bench; None for a new one
        self._found: list[DiscoveredDevice] = []
        self._saving = FileWork(self, lambda why: self._show_problem(why, None))
        self._search = FileWork(self, lambda why: self._show_problem(why, None))
        self.editors: dict[str, tuple[FormField, QWidget]] = {}
        self.sections, self.pages = QListWidget(), QStackedWidget()
        self.sections.setAccessibleName("Sections")
        self.sections.currentRowChanged.connect(self.pages.setCurrentIndex)
        self.camera, self.light = Choice("Connected camera"), Choice("Connected light")
        self._choices = {"camera": self.camera, "light": self.light}
        self.devices = QWidget()
        connected = QFormLayout(self.devices)
        connected.setContentsMargins(0, 0, 0, 0)
        for kind, choice in self._choices.items():
            choice.textActivated.connect(partial(self._choose_device, kind))
            connected.addRow(f"Connected {kind}", choice)
        self.failed = label("", "dim", is_wrapped=True)
        connected.addRow(self.failed)
        self.problem = ElidedLabel(lines=2)
        self.apply = Button("Open", "", self._apply)
        about = "Save these settings as a bench file, and open it"
        self.save = Button("Save…", about, self._save)
        ends = row((self.problem, 1), self.apply, self.save, close_button(self, "Change nothing (Esc)"))
        parts = self.devices, (row(self.sections, (self.pages, 1)), 1), ends
        fill_dialog(self, *parts)

    def edit(self, bench: Bench, section: str) -> None:
        self.setWindowTitle("Settings of the bench")
        self.devices.hide()
        self.apply.setText("Apply")
        self.apply.setToolTip("Use these settings; registration and reconstruction change while the camera runs")
        self._begin(SettingsForm.of(bench), section)
        self._before = self._check()

    def make(self, template: Bench) -> None:
        """Make a bench after the example of another, with devices that are searched for."""
        self.setWindowTitle("New bench from my camera")
        self.devices.show()
        for choice in self._choices.values():
            choice.clear()
            choice.addItem("Searching\N{HORIZONTAL ELLIPSIS}")
            choice.setEnabled(False)
        self.apply.setText("Open")
        self.apply.setToolTip("Connect the devices with these settings")
        self._before = None
        self._begin(SettingsForm.of(template, is_new=True))
        if not self._search.is_busy:
            self._found = []
            self.failed.setText("")
            self._search.run(_discover, self._show_found)

    def _show_found(self, found: tuple[list[DiscoveredDevice], list[str]]) -> None:
        self._found, failed = found
        self.failed.setText("\n".join(_DETAIL.sub("", one).replace("`", "") for one in failed))
        self.failed.setToolTip("\n".join(failed))
        for kind, choice in self._choices.items():
            names = [device.name for device in self._found if device.kind == kind]
            choice.clear()
            choice.addItems([_NO_DEVICE if names else "None found: choose the driver below", *names])
            choice.setEnabled(bool(names))

    def _choose_device(self, kind: str, name: str) -> None:
        for device in self._found:
            if device.name == name and device.kind == kind:
                self._form.use_device(device)
                self._build(kind)

    def _begin(self, form: SettingsForm, section: str = "sensor") -> None:
        self._form = form
        self._build(section)
        self.show()
        self.activateWindow()

    def _build(self, shown: str) -> None:
        """Make the widgets of all fields; show one section."""
        self.editors = {}
        self.sections.setFocus()  # else Qt would give it from a removed editor to any other
        self.sections.clear()
        while (page := self.pages.widget(0)) is not None:
            self.pages.removeWidget(page)
            page.deleteLater()
        for section in self._form.sections():
            inner = QWidget()
            layout = QFormLayout(inner)
            layout.addRow(label(section.help, "dim", is_wrapped=True))
            for field in section.fields:
                editor = self._editor(field)
                editor.setAccessibleName(field.label)
                tip = re.sub(r"\b\w*_\w*\b", lambda key: NAMES.get(key[0], key[0]), field.help or field.label)
                editor.setToolTip(f"<p>{tip}</p>")
                self.editors[field.path] = (field, editor)
                layout.addRow(f"{field.label} ({field.unit})" if field.unit else field.label, editor)
            self.pages.addWidget(Scrolled(inner))
            self.sections.addItem(" \N{RIGHTWARDS ARROW} ".join(part.capitalize() for part in section.path.split(".")))
            if section.path == shown:
                self.sections.setCurrentRow(self.sections.count() - 1)
        self.sections.setFixedWidth(self.sections.sizeHintForColumn(0) + self.fontMetrics().height())
        self._check()

    def _editor(self, field: FormField) -> QWidget:
        if field.kind == "switch":
            box = QCheckBox()
            box.toggled.connect(lambda on: box.setText("yes" if on else "no"))
            box.setText("no")
            box.setChecked(field.text == "true")
            box.toggled.connect(lambda on: self._enter(field, box, "true" if on else "false"))
            return box
        if field.kind == "choice":
            choice = Choice(items=[(name_of(value) or "automatic", value) for value in field.choices])
            choice.setCurrentIndex(choice.findData(field.text))
            choice.activated.connect(lambda index: self._enter(field, choice, choice.itemData(index)))
            return choice
        line = QLineEdit(field.text)
        empty = "none" if field.kind == "toml" and not field.is_optional else "automatic" * field.is_optional
        line.setPlaceholderText(f"for example {field.example}" if field.example else empty)
        line.textEdited.connect(lambda text: self._enter(field, line, text))
        return line

    def _enter(self, field: FormField, editor: QWidget, text: str) -> None:
        try:
            self._form.set(field, text)
        except InputError as error:
            self._show_problem(str(error), editor)
            return
        if field.path.endswith(".driver"):
            self._build(field.path.split(".")[0])
        else:
            self._check()

    def _check(self) -> Bench | None:
        """Return the bench, or show what is wrong at its field."""
        left = []  # to be typed in a new bench
        for field, editor in self.editors.values():
            text = editor.text() if isinstance(editor, QLineEdit) else field.text
            if field.example and not text.strip():
                left.append(field.label)
                continue
            try:
                field.parse(text)
            except InputError as error:
                self._show_problem(str(error), editor)
                return None
        if left:
            self._show_problem(f"Still to be filled in: {', '.join(left)}", None)
            colour_text(self.problem, theme.DIM)
            return None
        try:
            bench = self._form.bench()
        except InputError as error:
            _, faulty = self.editors.get(fault_path(error), (None, None))
            fields = {path: field for path, (field, _) in self.editors.items()}
            self._show_problem(fault_in_words(error, fields), faulty)
            return None
        self._show_problem("", None)
        return bench

    def _show_problem(self, sentence: str, at: QWidget | None) -> None:
        self.problem.setText(sentence)
        colour_text(self.problem, theme.RED)
        for _, editor in self.editors.values():
            mark_refused(editor, is_refused=editor is at)
        for ending in (self.apply, self.save):
            ending.setEnabled(not sentence)

    def _apply(self) -> None:
        if (bench := self._check()) is None:
            return
        if self._before is None:  # a new bench
            self.close()
        self._use(bench, self._before)
        self._before = bench if self._before is not None else None

    def _save(self) -> None:
        bench = self._check()
        path = None if bench is None else ask_bench_file(self)
        if bench is None or path is None:
            return

        def leave(_: None) -> None:
            self.close()
            self._opened(str(path))

        self._saving.run(partial(save_bench, path, bench), leave, writes=str(path))


def ask_bench_file(parent: QWidget) -> Path | None:
    """Ask for the name of a bench file to write; None if the user does not want to."""
    return ask_file(parent, "Save the bench", "bench.toml", BENCH_FILES)


def _discover() -> tuple[list[DiscoveredDevice], list[str]]:
    """Search for devices; return them, and what cannot be searched for or used, with the reasons."""
    found, failed = list[DiscoveredDevice](), list[str]()
    for kind in KINDS:
        try:
            devices, missing = kind.discover()
        except Exception as error:  # noqa: BLE001 - every error is shown, and the other kinds are searched
            devices, missing = (), f"{type(error).__name__}: {error}"
        found += devices
        failed += [f"{kind.heading}, not searched: {missing}"] if missing else []
        failed += [f"{one.name} cannot be used yet: {one.missing}" for one in devices if one.missing]
    return found, failed
