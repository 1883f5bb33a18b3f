"""Recording: its buttons in the menu bar, and the bar with name, note, end and further use."""

import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path

from PyQt6.QtCore import QProcess, QProcessEnvironment, QSettings, QStandardPaths, Qt, QUrl
from PyQt6.QtGui import QDesktopServices
from PyQt6.QtWidgets import QFileDialog, QFrame, QMenu, QSizePolicy, QWidget

from app.acquisition.remote.connection import RunningInstrument
from app.gui.panels.panel import Entries
from app.gui.shell.controller import Controller
from app.gui.shell.menus import RecentFiles
from app.gui.shell.status_text import gaps_in_words, recording_ended
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button, Choice, Refusal, Toggle
from app.gui.widgets.copies import ask_file
from app.gui.widgets.fields import NumberField, TextField
from app.gui.widgets.file_work import FileWork, answer
from app.gui.widgets.layouts import fill_strip
from app.gui.widgets.presentation import percent
from app.gui.widgets.texts import ElidedLabel, colour_text, label, mark_refused
from app.progress import LINE_START, LINES, counted
from app.recording.folder import describe, name_problem, read_run
from app.recording.recorder import RECENT_S, RecordingLimit, RecordingState
from app.results.export import EXPORT_FORMATS, Format
from app.run_facts import command_line
from drivers.interface import Range

_WIDEST = "disk space for 000 min"  # of more, the end is elided: the tool tip has it
_STOP = "Stop REC"  # another word than that of the camera
_LIMITS = Range(0, 1e6)  # of frames or seconds after which a recording ends
_BEHIND = 70  # waiting frames from which the number is shown
_DISK_INTERVAL_S = 5.0  # between two queries of the free disk space
_END_MS = 3000  # for a command that is to end
_NAME_TIP = "Appended to the name of the folder when the recording is finished"
_CUT_OFF = "its instrument has died: Recover completes it"
_FOLDER = "folders/recordings"  # key of the saved state

Command = tuple[str | Path, ...]  # and its arguments


class RecordingPanel(QWidget):
    """Buttons, and the state of the recording."""

    def __init__(self) -> None:
        super().__init__()
        about = "Record every frame with all data needed to reconstruct it again (W)"
        self.record = Toggle("Record", about, self._leave_fields)
        self.keep = Button(f"Save last {RECENT_S:g} s", f"Save the last {RECENT_S:g} s as a recording (K)")
        self.text = ElidedLabel("dim")
        self.text.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        self.text.setFixedSize(self.text.fontMetrics().horizontalAdvance(_WIDEST), self.text.minimumHeight())
        self.text.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.next = Button("\N{HORIZONTAL ELLIPSIS}", "Name, note and end of the next recording (Shift+W)")
        self.next.setProperty("role", "more")
        self.next.setAccessibleName("Name, note and end of the recording")
        fill_strip(self, self.text, self.keep, self.record, self.next)
        self._show_button(is_recording=True)
        self.record.setMinimumWidth(self.record.sizeHint().width())  # of the longer of its two texts
        theme.follow(self, lambda: self._show_button(is_recording=self.record.isChecked()))
        self.refusal = Refusal(self)
        self.show_state(None)

    def show_state(
        self, state: RecordingState | None, free_minutes: float = math.inf, *, is_starting: bool = False
    ) -> None:
        """Show the current or last recording and the recording time that the disk has space for."""
        is_recording = is_starting or (state is not None and state.stage == "recording")
        self.record.setChecked(is_recording)
        if (self.record.text() == _STOP) != is_recording:
            self._show_button(is_recording=is_recording)
        self.record.setEnabled(state is None or state.stage != "finishing")
        lasts = f"{free_minutes / 60:.0f} h" if free_minutes >= 600 else f"{free_minutes:.0f} min"
        room = () if math.isinf(free_minutes) else (f"disk space for {lasts}",)
        text = "   ".join((*_progress(state), *room))
        is_narrow = self.text.fontMetrics().horizontalAdvance(text) > self.text.width()
        self.text.setText("   ".join(_progress(state)) if is_narrow else text)
        colour_text(self.text, theme.RED if is_recording else theme.DIM)
        self.text.setToolTip(text if state is None else f"{text}\n{state.folder}")

    def _leave_fields(self) -> None:
        if (window := self.window()) is not None:
            window.setFocus()

    def _show_button(self, *, is_recording: bool) -> None:
        self.record.setText(_STOP if is_recording else "Record")
        self.record.setIcon(theme.start_or_stop(is_running=True) if is_recording else theme.lamp(theme.RED))


def _progress(state: RecordingState | None) -> tuple[str, ...]:
    if state is None:
        return ()
    minutes, seconds = divmod(round(state.seconds), 60)
    behind = (f"{state.waiting} waiting for the disk",) if state.waiting > _BEHIND else ()
    gap = (gaps_in_words(state.gaps),) if state.gaps else ()
    lasts = f"{minutes}:{seconds:02d}"
    began = (f"REC {lasts}", str(state.frames)) if state.stage == "recording" else (counted(state.frames), lasts)
    return (*began, *gap, *behind)


@dataclass
class _Finished:
    """A finished recording."""

    folder: Path  # another one after it was named
    state: RecordingState  # at its end


class RecordingBar(QFrame):
    """Records as a `RecordingPanel` asks; opens when a recording begins, and stays until it is closed."""

    def __init__(self, controller: Controller, panel: RecordingPanel, saved: QSettings | None) -> None:
        """Remember the recordings, and their folder, in what is `saved`."""
        super().__init__()
        self.setProperty("role", "strip")
        self._controller, self._messages, self._panel = controller, controller.messages, panel
        panel.record.clicked.connect(self._record)
        panel.next.clicked.connect(self.prepare)
        panel.keep.clicked.connect(
            lambda: controller.send(lambda to: to.keep_recent(self._new_folder("-kept"), may_rename=True))
        )
        controller.connected.connect(self._restart)
        self._saved, self.recordings_folder = saved, _recordings_folder(saved)
        self._starting: Future[None] | None = None  # the last start of a recording
        self._ended: set[Path] = set()  # recordings whose end was shown
        self._free_minutes, self._disk_due_s = math.inf, -math.inf
        self._asked_disk: Future[float] | None = None  # a network disk may not answer
        self.recent = RecentFiles(saved, "recent/recordings")
        self._began: Path | None = None  # folder of the recording as it began
        self._finished: _Finished | None = None
        self._naming = FileWork(self, self._messages.warn)
        self._opening = FileWork(self, self._messages.warn)
        self.text = ElidedLabel()
        self._make_description()
        self._make_limit()
        self._make_uses()
        self.done = Button("Close", "Hide this bar", self.hide)
        described = (self.text, 3), (self.name, 2), (self.note, 3)
        fill_strip(self, *described, *self._of_limit, self.recover, *self._uses, self.done)
        self._forget()
        self.hide()

    def _make_description(self) -> None:
        self._name_problem = ""
        self.name = TextField(tool_tip=_NAME_TIP, hint="name")
        self.note = TextField(tool_tip="Saved in run.json and shown in the report", hint="note")
        for field in (self.name, self.note):
            field.setMinimumWidth(90)
            field.entered.connect(lambda _: self._describe())
        self.name.textChanged.connect(self._check_name)

    def _make_limit(self) -> None:
        self.stop_after = NumberField(name="Stop after", tool_tip="The recording ends by itself", lowest="never")
        self.unit = Choice("Frames, or seconds between the first and the last", ("frames", "s"))
        self.stop_after.entered.connect(lambda _: self._limit())
        self.unit.activated.connect(lambda _: self._limit())
        self._of_limit = (label("Stop after", "dim"), self.stop_after, self.unit)

    def _make_uses(self) -> None:
        self.open = Button("Open folder", "Show the files", lambda: self._use(self._show))
        about = "Play the recording in another window; the devices keep running here"
        self.replay = Button("Replay", about, lambda: self._use(self.play))
        about = "Write report.pdf into the folder and open it"
        self.report = Button("Report", about, lambda: self._use(self._report))
        self.export = Button("Export", "Write it for other programs")
        self.exports = QMenu(self)
        for to, (text, _) in EXPORT_FORMATS.items():
            self.exports.addAction(text, lambda _=False, to=to: self._use(partial(self._export, to)))
        self.export.setMenu(self.exports)
        self._uses = (self.open, self.replay, self.report, self.export)
        about = "Complete the recording: its instrument has died"
        self.recover = Button("Recover", about, lambda: self._use(self._recover))

    @property
    def folder(self) -> Path | None:
        """Folder of the finished recording, with its name."""
        return None if self._finished is None else self._finished.folder

    @property
    def limit(self) -> RecordingLimit:
        value = self.stop_after.value()
        if value and self.unit.currentText() == "frames":
            return RecordingLimit(frames=round(value))
        return RecordingLimit(seconds=value) if value else RecordingLimit()

    def prepare(self) -> None:
        if self._stage != "recording":
            self._forget()
        self.show()
        self.name.setFocus()  # what is typed now is its name

    def use_folder(self, folder: Path) -> None:
        self.recordings_folder = folder
        if self._saved is not None:
            self._saved.setValue(_FOLDER, str(folder))
        self._messages.inform(f"recordings are saved in {folder}")

    def _choose(self, title: str, act: Callable[[Path], object]) -> None:
        """Ask for a folder, and act on it."""
        if chosen := QFileDialog.getExistingDirectory(self, title, str(self.recordings_folder)):
            act(Path(chosen))

    def ask_to_end(self, then: Callable[[], object]) -> None:
        """Call `then`, after the user has agreed that a recording ends."""
        state = None if self._controller.acquisition is None else self._controller.acquisition.recording
        if state is None or state.stage != "recording" or self._controller.left:  # it continues, in its own process
            then()
        else:
            question = f"the recording {state.folder.name} ends if another bench is opened"
            self._messages.ask(question, then, "End it and open", "Keep recording", is_destructive=True)

    def refresh(self) -> None:
        """Show the state of the recordings, and each end once."""
        acquisition = self._controller.acquisition
        if acquisition is None:
            return
        self._query_disk(acquisition)
        state, kept = acquisition.recording, acquisition.kept
        is_starting = self._starting is not None and not self._starting.done()
        if state is not None and not state.is_over and self._controller.is_lost:
            state = replace(state, stage="ended early", problem=_CUT_OFF)
        is_replay = acquisition.status is not None and acquisition.status.is_replay  # which records nothing
        self._panel.show_state(state, math.inf if is_replay else self._free_minutes, is_starting=is_starting)
        if state is not None and state.folder != self._began:
            if self.folder is not None:
                self._forget()
            self._began = state.folder
            self.show()
        is_recording = state is not None and not state.is_over
        if state is not None and is_recording:
            self._ended.discard(state.folder)  # one of this name was removed
            self._show_stage(state)
        for ended in (state, kept):
            if ended is not None and ended.is_over and ended.folder not in self._ended:
                self._ended.add(ended.folder)
                show = self._messages.alarm if ended.stage == "ended early" else self._messages.inform
                show(recording_ended(ended))
                if ended is kept and not is_recording:
                    self._forget()  # name and note were not for it
                if not is_recording:
                    self._finish(ended)

    def _query_disk(self, acquisition: RunningInstrument) -> None:
        if self._asked_disk is not None and self._asked_disk.done():
            is_unknown = self._asked_disk.exception() is not None  # the start of a recording reports it
            self._free_minutes = math.inf if is_unknown else self._asked_disk.result()
            self._asked_disk = None
        if self._asked_disk is None and time.monotonic() > self._disk_due_s:
            self._disk_due_s = time.monotonic() + _DISK_INTERVAL_S
            self._asked_disk = acquisition.free_minutes(self.recordings_folder)

    def menu_entries(self) -> Entries:
        return (
            ("Start or stop recording", "W", self._panel.record),
            ("Name, note and end of the recording", "Shift+W", self.prepare),
            ("Save the last seconds", "K", self._panel.keep),
            ("Replay a recording…", "Ctrl+Shift+O", partial(self._choose, "Replay a recording", self.play)),
            ("Replay a recent recording", "", self.recent.menu(self, lambda folder: folder.name, self.play)),
            ("Recover a recording…", "", partial(self._choose, "Recover a recording", self._recover)),
            ("Choose the recordings folder…", "", partial(self._choose, "Recordings folder", self.use_folder)),
        )

    def play(self, folder: Path) -> None:
        self._opening.run(partial(read_run, folder), lambda _: self._start_window(folder))

    def _start_window(self, folder: Path) -> None:
        """Replay a recording in another window, which lives on when this one closes."""
        started, _ = QProcess.startDetached(*command_line("live", "--replay", folder))
        if not started:
            self._messages.warn("another window could not be started")

    def _restart(self) -> None:
        """Continue with another acquisition."""
        self._starting = self._asked_disk = None
        acquisition = self._controller.acquisition
        state = None if acquisition is None else acquisition.recording
        was_recording = self._stage in {"recording", "finishing"}
        if was_recording and self._began is not None and (state is None or state.folder != self._began):
            self._forget()

    def _record(self, is_on: bool) -> None:
        acquisition = self._controller.acquisition
        if acquisition is None:
            return
        if is_on:
            self._messages.alarm("")
            folder, limit = self._new_folder(), self.limit
            self._starting = self._controller.send(lambda to: to.start_recording(folder, limit=limit, may_rename=True))
            if acquisition.status is not None and not acquisition.status.is_light_on:
                self._messages.warn("recording with the light off: L switches it on, W ends the recording")
        elif self._starting is None or self._starting.done() or not self._starting.cancel():  # it starts, or is on
            self._controller.send(lambda to: to.stop_recording())

    def _new_folder(self, suffix: str = "") -> Path:
        return self.recordings_folder / f"{datetime.now().astimezone():%Y%m%d-%H%M%S}{suffix}"

    def _forget(self) -> None:
        self._finished = None
        self.stop_after.show_value(0, _LIMITS)
        self.name.show_text("")
        self.note.show_text("")
        self._show_stage(None)

    def _finish(self, state: RecordingState) -> None:
        self._finished = _Finished(state.folder, state)
        self.stop_after.show_value(0, _LIMITS)  # the limit was for this recording
        self._show_stage(state)
        self.show()
        if (self.name.text() or self.note.text()) and state.problem != _CUT_OFF:  # else when it is recovered
            self._describe()
        else:
            self.recent.add(state.folder)

    def _show_stage(self, state: RecordingState | None) -> None:
        self._stage = "" if state is None else state.stage
        is_over, is_cut_off = state is not None and state.is_over, state is not None and state.problem == _CUT_OFF
        for widget in self._of_limit:
            widget.setVisible(not is_over)
        for each in self._uses:
            each.setVisible(is_over and (each is self.open or bool(state and state.frames and not is_cut_off)))
        self.recover.setVisible(is_cut_off)
        if state is None:
            self.text.setText("Next recording")
            return
        folder = self.folder or state.folder
        self.text.setText(f"{counted(state.frames)} in {folder.name}" if is_over else f"Recording {state.folder.name}")
        self.text.setToolTip(str(folder))

    def _limit(self) -> None:
        self._controller.send(lambda to: to.limit_recording(self.limit))

    def _check_name(self, name: str) -> None:
        """Show in red, and say, why a name that is being typed cannot be used."""
        problem = name_problem(name.strip())
        mark_refused(self.name, is_refused=bool(problem))
        self.name.setToolTip(problem or _NAME_TIP)
        if problem != self._name_problem:
            self._name_problem = problem
            self._messages.refuse(problem)

    def _describe(self) -> None:
        if (finished := self._finished) is None:
            return
        name, note = self.name.text(), self.note.text()

        def save() -> None:
            finished.folder = describe(finished.folder, name=name, note=note)  # the one before may have renamed it

        def show(_: None) -> None:
            self._messages.inform(f"saved as {finished.folder}")
            if finished is self._finished:
                self.text.setText(f"{self.text.text().partition(' in ')[0]} in {finished.folder.name}")
                self.text.setToolTip(str(finished.folder))
            self.recent.add(finished.folder)

        self.recent.add(finished.folder)
        self._naming.run(save, show, writes=f"name and note of {finished.folder}")

    def _use(self, act: Callable[[Path], object]) -> None:
        """Act on the finished recording, as soon as its folder has the name that was typed."""
        if (finished := self._finished) is None:
            return
        if self._naming.is_busy:
            self._naming.run(lambda: finished.folder, act)
        else:
            act(finished.folder)

    def _show(self, path: Path) -> None:
        if not QDesktopServices.openUrl(QUrl.fromLocalFile(str(path))):
            self._messages.alarm(f"{path} cannot be shown here: this desktop has no program for it")

    def _report(self, folder: Path) -> None:
        out = folder / "report.pdf"
        command = "report", folder, "--out", out, "--overwrite"
        begin, end = f"writing the report of {folder.name}", f"the report is in {out}"
        self._run(self.report, command, begin, end, lambda: self._show(out))

    def _recover(self, folder: Path) -> None:
        def show() -> None:
            if (finished := self._finished) is not None and finished.folder == folder:
                self._finish(replace(finished.state, problem=""))

        end = f"recording {folder.name} is complete"
        self._run(self.recover, ("recover", folder), f"recovering {folder.name}", end, show)

    def _export(self, to: Format, folder: Path) -> None:
        what, suffixes = EXPORT_FORMATS[to]
        proposed = str(folder.with_name(f"{folder.name}{suffixes[0]}"))
        name = ask_file(self, what, proposed, " ".join(f"*{suffix}" for suffix in suffixes))
        if name is not None:  # the dialog has asked whether to replace it
            command = "export", folder, "--to", to, "--out", name, "--overwrite"
            self._run(self.export, command, f"exporting {folder.name}", f"exported to {name}")

    def _run(
        self, by: Button, command: Command, begin: str, end: str, then: Callable[[], object] = lambda: None
    ) -> None:
        """Run a command of svwfs in another process, by a button that shows the progress; say its begin and end."""
        process, name, errors = QProcess(self), by.text(), list[str]()
        environment = QProcessEnvironment.systemEnvironment()
        environment.insert(LINES, "1")
        process.setProcessEnvironment(environment)
        by.setEnabled(False)

        def read() -> None:
            while process.canReadLine():
                line = bytes(process.readLine().data()).decode(errors="replace").strip()
                if line.startswith(LINE_START):
                    by.setText(f"{name} {percent(float(line.removeprefix(LINE_START)))}")
                elif line:
                    errors.append(line)

        def finish(status: int, how: QProcess.ExitStatus) -> None:
            read()
            process.deleteLater()
            by.setText(name)
            by.setEnabled(True)
            if how is QProcess.ExitStatus.NormalExit and status == 0:
                self._messages.inform(end)
                then()
            else:
                self._messages.alarm(errors[-1].removeprefix("svwfs: ") if errors else f"{begin}: failed")

        process.setReadChannel(QProcess.ProcessChannel.StandardError)
        process.readyReadStandardError.connect(read)
        process.finished.connect(finish)
        self._messages.inform(begin)
        process.start(*command_line(*command))

    def end_commands(self) -> None:
        """End the commands that still run; their output files appear only when they are whole."""
        for process in self.findChildren(QProcess):
            process.blockSignals(True)
            process.terminate()
            if not process.waitForFinished(_END_MS):
                process.kill()
                process.waitForFinished(_END_MS)


def _recordings_folder(saved: QSettings | None) -> Path:
    """Return the folder that was chosen last, unless it has gone, else one that no cloud synchronises."""
    chosen = None if saved is None else saved.value(_FOLDER)
    if isinstance(chosen, str) and answer(Path(chosen).is_dir, otherwise=True):
        return Path(chosen)
    return Path(QStandardPaths.writableLocation(QStandardPaths.StandardLocation.HomeLocation) or ".") / "svwfs"
