"""The recording bar: name, note and end of a recording, and what can be done with it afterwards."""

from __future__ import annotations

from pathlib import Path

from PyQt6.QtCore import QSettings, QUrl
from PyQt6.QtGui import QDesktopServices
from PyQt6.QtWidgets import QFileDialog, QFrame, QMenu, QWidget

from app.errors import InputError, RunError
from app.gui import theme
from app.gui.background_commands import BackgroundCommands
from app.gui.controller import Controller
from app.gui.message_strip import MessageStrip
from app.gui.number_field import NumberField
from app.gui.recent_files import RecentFiles
from app.gui.text_field import TextField
from app.gui.widgets import Choice, ElidedLabel, button, label, row
from app.progress import counted
from app.recording.folder import describe, name_problem
from app.recording.recorder import Limit, RecordingState
from drivers.interface import Range

_FRAMES, _SECONDS = "frames", "s"
_MOST = Range(0, 1e6)
_NAME_TIP = "Appended to the name of the folder when the recording is finished"
_EXPORTS = {  # suffix and what is written
    "tiff": ("tif", "Frames as TIFF"),
    "csv": ("csv", "RMS and coefficients as CSV"),
    "netcdf": ("nc", "All results as NetCDF"),
    "psf": ("tif", "Point-spread functions as TIFF"),
    "zernike-table": ("csv", "Zernike coefficients as CSV"),
    "double-zernike": ("nc", "Double Zernikes as NetCDF"),
}


class RecordingBar(QFrame):
    """Opens when a recording begins; stays until it is closed."""

    def __init__(
        self, controller: Controller, messages: MessageStrip, settings: QSettings | None, parent: QWidget | None = None
    ) -> None:
        """Follow the recordings of the controller, limit them, and remember them in `settings`."""
        super().__init__(parent)
        self.setProperty("role", "strip")
        self._controller, self._messages = controller, messages
        controller.limit = lambda: self.limit
        self.recent = RecentFiles(settings, "recent/recordings")
        self.commands = BackgroundCommands(messages, self)
        self._of: Path | None = None  # the recording as it began
        self.folder: Path | None = None  # with its name, once it is finished
        self._kept: Path | None = None
        self.text = ElidedLabel()
        self._name_problem = ""
        self.name = TextField(tool_tip=_NAME_TIP, hint="name")
        self.note = TextField(tool_tip="Kept in run.json and shown in the report", hint="note")
        for field in (self.name, self.note):
            field.setMinimumWidth(90)
            field.entered.connect(lambda _: self._describe())
        self.name.textChanged.connect(self._check_name)
        self.stop_after = NumberField(name="Stop after", tool_tip="The recording ends by itself", lowest="never")
        self.stop_after.show_value(0, _MOST)
        self.unit = Choice()
        self.unit.addItems([_FRAMES, _SECONDS])
        self.unit.setToolTip("Frames, or seconds between the first and the last")
        self.stop_after.entered.connect(lambda _: self._limit())
        self.unit.textActivated.connect(lambda _: self._limit())
        self.open = button("Open folder", "Show the files", self._open)
        self.replay = button("Replay", "Play it in another window; the devices go on here", self._replay)
        self.report = button("Report", "Write report.pdf into the folder and open it", self._report)
        self.export = button("Export", "Write it for other programs", lambda: None)
        self.exports = QMenu(self)
        for to, (_, text) in _EXPORTS.items():
            if (action := self.exports.addAction(text)) is not None:
                action.triggered.connect(lambda _=False, to=to: self._export(to))
        self.export.setMenu(self.exports)
        self.done = button("Close", "Hide this bar", self.hide)
        self._afterwards = (self.open, self.replay, self.report, self.export)
        limits = (label("Stop after", "dim"), self.stop_after, self.unit)
        self._limits = limits
        row((self.text, 3), (self.name, 2), (self.note, 3), *limits, *self._afterwards, self.done, parent=self)
        if (layout := self.layout()) is not None:
            layout.setContentsMargins(10, 3, 6, 3)
        self._show_stage(None)
        self.hide()

    @property
    def limit(self) -> Limit:
        """When the next recording ends by itself."""
        value = self.stop_after.value()
        if not value:
            return Limit()
        return Limit(frames=round(value)) if self.unit.currentText() == _FRAMES else Limit(seconds=value)

    def prepare(self) -> None:
        """Open for the next recording."""
        if self._stage != "recording":
            self._forget()
        self.show()
        self.stop_after.edit()  # not the name: it would take the letters of shortcuts, also the light's

    def refresh(self) -> None:
        """Show the state of the recording."""
        acquisition = self._controller.acquisition
        if acquisition is None:
            return
        state, kept = acquisition.recording, acquisition.kept
        if state is not None and state.folder != self._of:
            if self.folder is not None:
                self._forget()
            self._of = state.folder
            self.show()
        if kept is not None and kept.folder != self._kept and _is_over(kept):
            self._kept = kept.folder
            if state is None or _is_over(state):
                self._forget()
                self._finish(kept)
        if state is not None and state.folder == self._of and self.folder is None:
            self._show_stage(state)
            if _is_over(state):
                self._finish(state)

    def recent_menu(self) -> QMenu:
        """Return a menu of the recent recordings."""
        menu = QMenu(self)

        def fill() -> None:
            menu.clear()
            for folder in self.recent.paths():
                if (action := menu.addAction(folder.name)) is not None:
                    action.setToolTip(str(folder))
                    action.triggered.connect(lambda _=False, folder=folder: self.play(folder))
            if menu.isEmpty() and (none := menu.addAction("None yet")) is not None:
                none.setEnabled(False)

        menu.aboutToShow.connect(fill)
        return menu

    def play(self, folder: Path) -> None:
        """Play a recording in another window."""
        self.commands.start_window("--replay", folder)

    def _forget(self) -> None:
        self.folder = None
        self.name.show_text("")
        self.note.show_text("")
        self._show_stage(None)

    def _finish(self, state: RecordingState) -> None:
        self.folder = state.folder
        self._show_stage(state)
        self.show()
        if self.name.text() or self.note.text():
            self._describe()
        else:
            self.recent.add(self.folder)

    def _show_stage(self, state: RecordingState | None) -> None:
        self._stage = "" if state is None else state.stage
        is_over = state is not None and _is_over(state)
        for widget in self._limits:
            widget.setVisible(not is_over)
        for each in self._afterwards:
            each.setVisible(is_over)
        if state is None:
            text = "Next recording"
        elif is_over:
            text = f"{counted(state.frames)} in {(self.folder or state.folder).name}"
        else:
            text = f"Recording {state.folder.name}"
        self.text.setText(text)
        if state is not None:
            self.text.setToolTip(str(self.folder or state.folder))

    def _limit(self) -> None:
        acquisition = self._controller.acquisition
        if acquisition is not None:
            acquisition.limit_recording(self.limit)

    def _check_name(self, name: str) -> None:
        """Show in red, and say, why a name that is being typed cannot be used."""
        problem = name_problem(name)
        self.name.setStyleSheet(f"color: {theme.RED.name()};" if problem else "")
        self.name.setToolTip(problem or _NAME_TIP)
        if problem != self._name_problem:
            self._name_problem = problem
            self._messages.refuse(problem)

    def _describe(self) -> None:
        if self.folder is None:  # not finished
            return
        try:
            self.folder = describe(self.folder, name=self.name.text(), note=self.note.text())
        except (InputError, RunError) as error:
            self._messages.warn(str(error))
        else:
            self._messages.inform(f"saved as {self.folder}")
            self.text.setText(f"{self.text.text().partition(' in ')[0]} in {self.folder.name}")
            self.text.setToolTip(str(self.folder))
        self.recent.add(self.folder)

    def _open(self) -> None:
        if self.folder is not None:
            self._show(self.folder)

    def _show(self, path: Path) -> None:
        """Show a file in the program that the desktop has for it."""
        if not QDesktopServices.openUrl(QUrl.fromLocalFile(str(path))):
            self._messages.alarm(f"{path} cannot be shown here: this desktop has no program for it")

    def _replay(self) -> None:
        if self.folder is not None:
            self.play(self.folder)

    def _report(self) -> None:
        if self.folder is not None:
            out = self.folder / "report.pdf"
            self.commands.start(
                self.report,
                f"writing the report of {self.folder.name}",
                *("report", self.folder, "--out", out, "--overwrite"),
                end=f"the report is in {out}",
                then=lambda: self._show(out),
            )

    def _export(self, to: str) -> None:
        if self.folder is None:
            return
        suffix, what = _EXPORTS[to]
        proposed = str(self.folder.with_name(f"{self.folder.name}.{suffix}"))
        name, _ = QFileDialog.getSaveFileName(self, what, proposed, f"*.{suffix}")
        if name:  # the dialog has asked whether to replace it
            self.commands.start(
                self.export,
                f"exporting {self.folder.name}",
                *("export", self.folder, "--to", to, "--out", name, "--overwrite"),
                end=f"exported to {name}",
            )


def _is_over(state: RecordingState) -> bool:
    return state.stage in {"finished", "ended early"}
