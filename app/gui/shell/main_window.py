"""The main window: lays out the panels and refreshes them from the acquisition at up to 25 Hz."""

import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from PyQt6.QtCore import QEvent, QEventLoop, QMimeData, QSettings, QSize, Qt, QTimer, pyqtSignal
from PyQt6.QtGui import QCloseEvent, QDropEvent, QRegion, QResizeEvent
from PyQt6.QtWidgets import QApplication, QFileDialog, QFrame, QMainWindow, QMenu, QMenuBar, QWidget

from app.acquisition.address import CLOSING_S, NAME, NameTaken, NotRunning
from app.acquisition.instrument import Activity, Status
from app.acquisition.remote.connection import RunningInstrument, reach
from app.acquisition.start_up import DARK, REFERENCE
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.cache import release_memory
from app.errors import RunError
from app.gui.panels.panel import DisplayState, Entries
from app.gui.shell.analyses import Analyses
from app.gui.shell.benches import Benches
from app.gui.shell.calibration import CalibrationGuide
from app.gui.shell.controller import Controller, SettingsControl
from app.gui.shell.docks import PanelDocks, make_panels
from app.gui.shell.help import help_entries
from app.gui.shell.light_control import EmergencyKeys, LightControl
from app.gui.shell.menus import fill_menus
from app.gui.shell.messages import MessageStrip
from app.gui.shell.recording import RecordingBar, RecordingPanel
from app.gui.shell.replay_bar import ReplayBar
from app.gui.shell.sensor_region import SensorRegionDialog
from app.gui.shell.state import PreferencesDialog, fit_to_screen, restore_state, save_state
from app.gui.shell.status_line import StatusLine
from app.gui.shell.status_text import AlarmTracker, advice, data_freshness, left_behind, light_when_closing, way_out
from app.gui.shell.verdict import VerdictButton
from app.gui.widgets import theme
from app.gui.widgets.fields import NumberField
from app.gui.widgets.file_work import FileWork, answer
from app.gui.widgets.layouts import column, row
from app.gui.widgets.timers import REFRESH_MS, timer
from app.images import SUFFIXES
from app.measurement.measurement import Measurement
from app.results.player import InstrumentFactory
from app.timing import Timings
from drivers.light_source import MAY_BE_ON

WINDOW_SIZE = QSize(1440, 900)  # unless the screen is smaller
_FRAME_PX = 2  # of the red frame
MakeFor = Callable[[Bench], RunningInstrument]  # makes the acquisition of a bench
_REFRESHES_PER_TEXT = 5  # numbers that change more often than five times a second cannot be read


class MainWindow(QMainWindow):
    """The window of `svwfs live`.

    It takes the focus when it becomes active, and from a widget that is hidden or disabled. So every key is a shortcut
    until a field is clicked; Qt would give it to the first button or field in the Tab order.
    """

    measurement_shown = pyqtSignal(object)  # the Measurement, by reference

    def __init__(self, *, saved: QSettings | None = None, make_for: MakeFor = Acquisition, name: str = NAME) -> None:
        """Make an empty window that looks as `saved`; `make_for` and `name` are those of its instruments."""
        super().__init__()
        self._make_for, self._name = make_for, name
        self._saved, self.is_closing, self._refreshes = saved, False, 0
        self.unsaved: list[str] = []  # why files were not written when the window was closed
        self._status: Status | None = None  # as shown
        self._failure, self._activity, self._is_silent = "", Activity(), False
        self._notice = ""  # why commands are refused, as shown
        self._alarm_tracker = AlarmTracker()
        self._unpainted: tuple[Measurement, Timings, float] | None = None  # with the seconds of drawing so far
        self._rests_until_s = 0.0  # after a slow redraw
        self._known_errors: set[str] = set()  # that were shown since the alarm was dismissed, or a bench was opened
        self.messages = MessageStrip()
        self.messages.dismissed.connect(self._known_errors.clear)
        self.setAcceptDrops(True)

        self.shown = DisplayState(self)
        self.panels = make_panels(self.shown)
        self.controls = self.panels.controls
        self.status_line, self.verdict = StatusLine(), VerdictButton(self.shown)
        self.controller = Controller(self.messages)
        self.settings = SettingsControl(self.controller)
        self.guide = CalibrationGuide(self.controller, self.settings, self.panels.camera, self)
        self.light = LightControl(self.controller, self.controls, self.guide.end_for_light)
        self._emergency = EmergencyKeys(self.light.switch_off, self)
        self.region_dialog = SensorRegionDialog(self.controller, self)
        self.recording_panel = RecordingPanel()
        self.recording_bar = RecordingBar(self.controller, self.recording_panel, saved)
        self.replay = ReplayBar(self.controls, self.messages.warn)
        self.analyses = Analyses(self.panels, self.shown)
        self._lay_out()
        self.benches = Benches(self, self._open_bench, self.controller, self.settings, saved)
        self._connect()
        fill_menus(self.menu_bar, self._menus(), self._ask_while_recording)
        is_restored = saved is not None and restore_state(saved, self)
        fit_to_screen(self)
        if not is_restored:
            self.docks.restore_default()  # for this size
        self._timer = timer(self, REFRESH_MS, self.refresh)
        self._timer.start()
        self.recording_panel.setEnabled(False)
        self.update_text()

    def _lay_out(self) -> None:
        self.setWindowTitle("svwfs")
        self.resize(WINDOW_SIZE)
        below = QWidget()
        column(self.replay, row((self.messages, 1), self.status_line, spacing=12), spacing=4, parent=below)
        if (status_bar := self.statusBar()) is not None:
            status_bar.setSizeGripEnabled(False)
            status_bar.addPermanentWidget(below, 1)
            status_bar.setMinimumWidth(900)  # px: captions and plots need it, the controls perhaps more
        self._frame = QFrame(self)  # around all while a recording is under way
        self._frame.setProperty("role", "recording")
        self._frame.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self._frame.hide()
        self.docks = PanelDocks(self, self.panels, self.recording_bar)
        self.menu_bar, top = QMenuBar(), QWidget()  # a corner of a menu bar would never change its width
        self.menu_bar.setNativeMenuBar(False)
        top.setProperty("role", "strip")
        row(self.menu_bar, (self.verdict, 1), self.recording_panel, parent=top)
        self.setMenuWidget(top)

    def _connect(self) -> None:
        acts: dict[str, Callable[[Any], object]] = {
            "light": lambda is_on: self.light.switch(is_on=is_on),
            "dark": partial(self.light.take, DARK),
            "reference": partial(self.light.take, REFERENCE),
            "calibration": self.guide.begin,
            "lattice": lambda _: self.guide.find_lattice(),
            "auto_exposure": lambda _: self.guide.expose(),
            "sensor_region": lambda _: self.region_dialog.begin(),
            "method": lambda _: self.benches.edit("registration"),
        }
        self.controls.requested.connect(lambda name, value: acts[name](value))
        self.controls.wanted.connect(self.settings.want)
        self.shown.exclusion_requested.connect(lambda *which: self.settings.change(("lenslets", which)))
        self.messages.cancel_requested.connect(self.panels.camera.put_tool_away)
        self.messages.reconnect_requested.connect(self._reconnect)
        self.messages.control_requested.connect(self.controller.take_control)
        for panel in self.panels:
            panel.warned.connect(self.messages.warn)
            panel.informed.connect(self.messages.inform)
        self.analyses.failed.connect(self.messages.warn)
        self.verdict.cause_requested.connect(self._lead_to)
        for field in self.findChildren(NumberField):
            field.refused.connect(self.messages.refuse)
        theme.follow(self, self._forget_status)

    def _menus(self) -> Mapping[str, Entries]:
        """Return all menus, with the entries of the panels among those of the window."""
        full = Qt.WindowState.WindowFullScreen
        preferences: Entries = ()
        if self._saved is not None:  # else the window remembers nothing
            preferences = (("Preferences…", "", PreferencesDialog(self._saved, self).show),)
        menus: dict[str, Entries] = {
            "&File": (
                *self.recording_bar.menu_entries(),
                None,
                ("Open a frame…", "", self._choose_frame),
                *self._entries_of_panels("&File"),
                None,
                ("Quit", "Ctrl+Q", self.quit),
            ),
            "&Bench": (
                *self.benches.menu_entries(),
                None,
                *self._entries_of_panels("&Bench"),
                ("Check the background", "B", self.guide.check_background),
                ("Light off, from anywhere (also Pause)", "F12", self.light.switch_off),
                None,
                ("Undo the last dark, reference or change", "Ctrl+Z", self.guide.ask_undo),
                ("Cancel, discard or dismiss", "Esc", self.messages.escape),
                ("Reconnect after a failure", "Ctrl+R", self.messages.reconnect),
                None,
                ("Take control of the instrument", "", self.controller.take_control),
            ),
            "&View": (
                *self._entries_of_panels("&View"),
                ("Previous frame of a replay", ",", self.replay.back),
                ("Next frame of a replay", ".", self.replay.forth),
                None,
                ("Panels", "", self.createPopupMenu() or QMenu(self)),
                ("Restore default layout", "", self.docks.restore_default),
                *preferences,
                ("Full screen", "F11", lambda: self.setWindowState(self.windowState() ^ full)),
            ),
        }
        menus["&Help"] = help_entries(self, menus, self.messages, self._facts)
        return menus

    def _entries_of_panels(self, title: str) -> Entries:
        return tuple(entry for panel in self.panels for entry in panel.menu_entries().get(title, ()))

    def connect_devices(self) -> None:
        """Open the devices and start measuring; a light that the user switched off stays off."""
        self._timer.start()
        is_first = self.controller.acquisition is None
        try:
            self.controller.connect_devices(is_lit=not self.light.is_kept_off)
        except RunError as error:
            self._offer_another(error)
            return
        self.shown.measurement = self.shown.status = self._unpainted = None
        self._failure, self._activity = "", Activity("opening the devices")
        self._forget_status()
        self.status_line.restart()
        if not is_first:
            release_memory()  # of the instrument before, and of what was shown of it
        if self.light.is_kept_off:
            self.messages.warn("the light stays off, as you left it: L switches it on, then R takes a reference")
        self.update_text()

    def _offer_another(self, error: RunError) -> None:
        """Offer an instrument that can be had where the one that was asked for cannot."""
        status = self._status
        if isinstance(error, NameTaken):
            attach = InstrumentFactory(partial(reach, "window", self._name), begin=lambda _: ())
            self.messages.ask(str(error), partial(self.open, attach), "Attach", "Not now")
        elif isinstance(error, NotRunning) and status is not None:
            here = partial(self._open_bench, status.bench_in_force)
            self.messages.ask(f"{error}, or start it here", here, "Start it here", "Not now")
        else:
            self.messages.warn(str(error))
        self.update_text()

    def _open_bench(self, bench: Bench) -> None:
        self.open(InstrumentFactory(partial(self._make_for, bench)))

    def open(self, access: InstrumentFactory) -> None:
        """Close the devices, after questions about recording and light, and connect others unless one hangs."""

        def connect() -> None:
            self._timer.stop()
            self.controller.close(self._show_closing)
            if self.controller.is_stuck and not self.controller.is_silent:
                self.messages.warn(left_behind(self.controller.status, CLOSING_S))
                self._timer.start()
                return
            self.controller.access = access
            if (status := self.controller.status) is not None and not self.controller.left:
                self.show_status(_ended(status))
            self.recording_bar.refresh()  # the recording has ended
            self._known_errors.clear()
            for panel in self.panels:
                panel.forget_bench()
            self.analyses.forget_bench()
            self.replay.use(access.player)
            self.light.is_kept_off &= access.player is None  # a recorded light shines on nobody
            self.connect_devices()

        self.recording_bar.ask_to_end(lambda: self.light.ask_off(connect))

    def refresh(self) -> None:
        """Show what is new: results of commands, status, and the newest measurement."""
        acquisition = self.controller.acquisition
        self._refreshes += 1
        if acquisition is None:
            self.analyses.poll()
            if self._refreshes % _REFRESHES_PER_TEXT == 0:
                self.update_text()
            return
        if any([self.controller.poll(), self.light.poll(), self.shown.wanted != self.settings.wanted]):
            self._forget_status()  # shown again, so that a refused value gives way to the one in force
        self._failure = acquisition.failure  # read once: message and buttons must agree
        self._activity = acquisition.activity  # before the status, which is that after a routine as soon as it ends
        status = acquisition.status
        if status is not None:
            self._show_changed(status)
        if MAY_BE_ON in self._failure or self._is_silent or self.controller.is_lost:
            self.controls.show_unreached_light()
        is_ready = self._status is not None and not self._failure and not self._is_silent
        self.controls.setEnabled(is_ready)
        if self.replay.isHidden() and self.controller.notice != self._notice:
            self._notice = self.controller.notice
            self.controls.refuse(self._notice)
            self._forget_status()
        self.recording_panel.setEnabled(is_ready and self.replay.isHidden() and not self._notice)
        self.recording_panel.refusal.reason = self._notice
        self.messages.show_activity(self._activity, may_cancel=is_ready)
        self.replay.refresh()
        if self._failure:
            self.update_text()
        elif self._refreshes % _REFRESHES_PER_TEXT == 0:
            self.update_text()  # before the frame is drawn: if that fails, the text says so
        measurement, start_s = acquisition.newest, time.perf_counter()
        is_new = measurement is not self.shown.measurement and not self.isMinimized()
        if measurement is not None and is_new and start_s > self._rests_until_s:
            self.show_measurement(measurement)
            self._unpainted = measurement, acquisition.timings, time.perf_counter() - start_s
        self.analyses.poll()

    def _show_changed(self, status: Status) -> None:
        """Show a changed status; failed devices, or those of a silent process, stand still."""
        if self.controller.is_silent is not self._is_silent:
            self._is_silent = not self._is_silent
            self._forget_status()
        if self._is_silent:
            status = replace(status, is_running=False)
        if self._failure:
            status = _ended(status)
        if status != self._status:
            self.show_status(status)

    def show_measurement(self, measurement: Measurement) -> None:
        is_first, self.shown.measurement = self.shown.measurement is None, measurement
        self.replay.show_measurement(measurement)
        for panel in self.panels:
            panel.show_measurement(measurement)
        self.status_line.count(measurement)
        if is_first:
            self.update_text()
        self.measurement_shown.emit(measurement)

    def show_status(self, status: Status) -> None:
        self._status = status
        marks = "SIMULATED" * status.bench.is_simulated, "attached" * self.controller.is_attached
        names = ", ".join(filter(None, (self.benches.name, status.camera_name, *marks)))
        self.setWindowTitle(f"svwfs \N{EM DASH} {names}")
        self.shown.reconstruction = status.bench.reconstruction
        self.shown.wanted, self.shown.is_settled = dict(self.settings.wanted), self.controller.is_settled
        for panel in self.panels:
            panel.show_status(status)
        if self.light.is_switching_off:
            self.controls.show_switching_off()
        self.replay.show_status(status)
        self.region_dialog.show_status(status)

    def update_text(self) -> None:
        status, shown, measurement = self._status, self.shown, self.shown.measurement
        shown.status = self.controller.status
        alarm = self._alarm_tracker.alarm(status, self._activity, measurement)
        was_grey = shown.data_freshness.is_grey
        shown.data_freshness = data_freshness(status, self._failure, self._activity, measurement)
        shown.problem = problem = self._failure or self._activity.text or alarm
        for panel in self.panels:
            panel.show_numbers()
            if shown.data_freshness.is_grey is not was_grey:
                panel.show_stale(is_stale=not was_grey)
        self.recording_bar.refresh()
        self._frame.setVisible(self.recording_panel.record.isChecked())
        self._frame.raise_()
        self.status_line.update_text(status, self.controller.about_processes, trouble=self.controller.trouble)
        tip = advice(status, self._activity, measurement)
        if self._failure:
            tip = way_out(status, is_lost=self.controller.is_lost)
        self.verdict.show_verdict(
            problem,
            is_failed=bool(self._failure),
            is_busy=bool(self._activity.text),
            mask_note="" if status is None else status.mask_note,
        )
        self.messages.show_state(
            failure=self._failure,
            may_reconnect=status is None or not status.is_replay,
            may_take_control=self.controller.may_take_control,
            warning="; ".join(filter(None, [alarm, self.controller.notice])),
            advice=tip,
        )

    def _ask_while_recording(self, text: str, act: Callable[[], object]) -> None:
        """Act, or ask first while frames are recorded: a key may have been typed by mistake."""
        if self.recording_panel.record.isChecked():
            self.messages.ask(f"{text}, while frames are recorded?", act, "Yes", "No", is_destructive=True)
        else:
            act()

    def _lead_to(self, cause: str) -> None:
        """Show a panel by its name, of a lost lenslet if there is one; without a name the log."""
        measurement = self.shown.measurement
        if cause == "lenslet" and measurement is not None and measurement.wavefront is not None:
            lost = np.argwhere(~measurement.wavefront.displacement.valid)
            self.panels.camera.inspect((int(lost[0, 0]), int(lost[0, 1])))
        elif cause:
            getattr(self.panels, cause).front_requested.emit()
        else:
            self.messages.show_log.click()

    def _choose_frame(self) -> None:
        """Show the frame of a file, with a search for layers of its own, as a dropped one."""
        kinds = f"Frame ({' '.join(f'*{suffix}' for suffix in SUFFIXES)})"
        name, _ = QFileDialog.getOpenFileName(self, "Open a frame", "", kinds)
        if name:
            self.open_file(Path(name))

    def open_file(self, path: Path) -> None:
        if answer(path.is_dir, otherwise=False):
            self.recording_bar.play(path)
        elif path.suffix == ".toml":
            self.benches.open(str(path))
        elif path.suffix.lower() in SUFFIXES:
            self.controller.send(lambda to: to.show_file(path))  # a badge says so
        else:
            kinds = "a recording's folder, a bench (.toml) or a frame (.tif, .fits, .png, .npy)"
            self.messages.warn(f"{path.name}: drop {kinds}")

    def _facts(self) -> dict[str, str]:
        status = self.controller.status
        devices = {} if status is None else {"Camera": status.camera_name, "Light": status.light_name}
        return {**devices, "Recordings": str(self.recording_bar.recordings_folder)}

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802 - Qt's name
        """Turn the light off at once; the window shows that it waits until the devices are closed."""
        if event is not None and (self.is_closing or event.spontaneous()):
            event.ignore()
            if not self.is_closing:
                self.quit()  # by the user
            return
        self.is_closing = True
        if self._saved is not None:
            save_state(self._saved, self)
        self._timer.stop()
        self.analyses.close()
        self.recording_bar.end_commands()
        self.region_dialog.close()
        self.controller.close(self._show_closing)
        self.recording_bar.refresh()  # end, name and note of a recording that was under way
        self.unsaved += [sentence for work in self.findChildren(FileWork) for sentence in work.close()]
        self.is_closing = False
        super().closeEvent(event)

    def _show_closing(self) -> None:
        """Paint what the window waits for, without taking any command."""
        for panel in (self.controls, self.recording_panel):
            panel.setEnabled(False)
        if (status := self.controller.status) is not None and not self.controller.left:
            self.show_status(replace(status, is_running=False))
            self.messages.show_closing(light_when_closing(status))
        QApplication.processEvents(QEventLoop.ProcessEventsFlag.ExcludeUserInputEvents)

    def quit(self) -> None:
        """Close the window, after questions about the instrument's process or a manual light."""

        def close() -> None:
            QTimer.singleShot(0, self.close)  # within a close event, Qt would skip `closeEvent`

        if not self.controller.ask_to_leave(close, self):
            self.light.ask_off(close)

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802 - Qt's name
        super().resizeEvent(event)
        inner = self.rect().adjusted(_FRAME_PX, _FRAME_PX, -_FRAME_PX, -_FRAME_PX)
        self._frame.setGeometry(self.rect())
        self._frame.setMask(QRegion(self.rect()).subtracted(QRegion(inner)))  # nothing else is painted twice

    def event(self, event: QEvent | None) -> bool:
        """Take the focus when active, open what is dropped, and time the painting at UpdateRequest."""
        if event is not None and event.type() == QEvent.Type.WindowActivate:
            self.setFocus()
        if isinstance(event, QDropEvent) and (paths := _paths(event.mimeData())):  # also its subclasses: enter, move
            event.setDropAction(Qt.DropAction.CopyAction)  # after a move, the source may delete its file
            event.accept()
            for path in paths if event.type() == QEvent.Type.Drop else ():
                self.open_file(path)
            return True
        if event is None or event.type() != QEvent.Type.UpdateRequest or self._unpainted is None:
            return super().event(event)
        (measurement, timings, seconds), self._unpainted = self._unpainted, None
        start_s = time.perf_counter()
        is_handled = super().event(event)  # paints the whole window
        end_s = time.perf_counter()
        took_s = seconds + end_s - start_s
        self._rests_until_s = end_s + took_s - REFRESH_MS / 1e3  # for commands and the instrument
        timings.note("draw", took_s)
        timings.note("to_screen", end_s - measurement.exposure_end_s)
        return is_handled

    @contextmanager
    def reported_errors(self) -> Iterator[None]:
        """Show errors of timers and slots, after which Qt would abort with the light on, and print each once."""
        before, known, alarm = sys.excepthook, self._known_errors, self.messages.alarm
        # Each thread that is made meanwhile keeps `report`, which must not keep the window.

        def report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
            if isinstance(error, Exception):
                at = traceback.extract_tb(trace)[-1]
                sentence = (
                    f"the display failed ({type(error).__name__}: {error}; {Path(at.filename).name}:{at.lineno}), so"
                    " that what you see may be old: open the bench again, and report this line of the log (Ctrl+L)"
                )
                if sentence in known:
                    return
                known.add(sentence)
                alarm(sentence)
            before(kind, error, trace)

        sys.excepthook = report
        try:
            yield
        finally:
            sys.excepthook = before

    def focusNextPrevChild(self, next: bool) -> bool:  # noqa: A002, N802 - Qt's names
        """Move the focus as Tab does, unless its widget has just been hidden or disabled."""
        focused = self.focusWidget()
        if focused is not None and not (focused.isVisible() and focused.isEnabled()):
            self.setFocus()
            return True
        return super().focusNextPrevChild(next)

    def _reconnect(self) -> None:
        if self.controller.failure:
            self.connect_devices()

    def _forget_status(self) -> None:
        """Show the status again, for example since icons are drawn in another theme."""
        self._status = None


def _ended(status: Status) -> Status:
    """Status of devices that are closed; a light without a driver stays as it is."""
    return replace(status, is_running=False, is_light_on=status.is_light_on and status.bench.has_manual_light)


def _paths(data: QMimeData | None) -> list[Path]:
    return [] if data is None else [Path(url.toLocalFile()) for url in data.urls() if url.isLocalFile()]
