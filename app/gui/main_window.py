"""The main window: lays out the views and refreshes them from the acquisition up to 25 times a second."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from PyQt6.QtCore import QEvent, QEventLoop, QSettings, QTimer, pyqtSignal
from PyQt6.QtGui import QCloseEvent
from PyQt6.QtWidgets import QApplication

from app.acquisition.instrument import Status
from app.acquisition.start_up import FRAMES, start_up
from app.acquisition.worker import Acquisition, Activity, Measurement
from app.bench.config import Bench
from app.gui.analysis_tabs import AnalysisTabs
from app.gui.automatic_tips import show_automatic
from app.gui.background_analysis import BackgroundAnalysis
from app.gui.base_window import BaseWindow
from app.gui.bench_files import BenchFiles
from app.gui.camera_panel import CameraPanel
from app.gui.controller import Begin, Controller
from app.gui.controls_panel import ControlsPanel
from app.gui.file_drop import FileDrop
from app.gui.guard import Guard
from app.gui.help_menu import help_entries
from app.gui.late_measurements import LateMeasurements
from app.gui.menu import fill_menus
from app.gui.message_log import MessageLog
from app.gui.message_strip import MessageStrip
from app.gui.number_field import NumberField
from app.gui.recording_bar import RecordingBar
from app.gui.recording_panel import RecordingPanel
from app.gui.replay_bar import ReplayBar
from app.gui.sensor_region_dialog import SensorRegionDialog
from app.gui.situation import Situation, liveness
from app.gui.status_line import StatusLine
from app.gui.wavefront_panel import WavefrontPanel
from app.gui.window_layout import lay_out
from app.gui.window_menus import window_menus
from app.gui.window_state import fit_to_screen, restore_state, save_state
from app.gui.wording import advice, is_replay, light_when_closing, way_out
from app.results.pictures import frame_statistics
from app.results.player import Player

_REFRESH_INTERVAL_MS = 40
_REFRESHES_PER_TEXT = 5  # numbers that change more often than five times a second cannot be read


class MainWindow(BaseWindow):
    """The window of `svwfs live`."""

    measurement_shown = pyqtSignal(object)  # the Measurement, by reference

    def __init__(
        self,
        make_acquisition: Callable[[], Acquisition] | None,
        *,
        settings: QSettings | None = None,
        make_for: Callable[[Bench], Acquisition] = Acquisition,
    ) -> None:
        """Make an empty window; `connect_devices` starts an acquisition, unless `open` does.

        `make_for` makes the acquisition of a bench that is opened in the window. The window looks as saved in
        `settings`, and saves how it looks when it closes.
        """
        super().__init__()
        self._settings, self._is_closing, self._refreshes = settings, False, 0
        self._measurement: Measurement | None = None
        self._status: Status | None = None
        self._failure, self._activity = "", Activity()
        self._late = LateMeasurements()
        self._situation, self._wanted = Situation(), dict[str, Any]()  # settings as shown that are not in force yet

        self.camera_panel = CameraPanel()
        self.wavefront_panel = WavefrontPanel()
        self.tabs = AnalysisTabs(self.wavefront_panel, self)
        self.analysis_panel = self.tabs.quality
        self.controls = ControlsPanel(FRAMES)
        self.recording_panel = RecordingPanel()
        self.replay = ReplayBar(self.controls)
        self.messages = MessageStrip()
        self.log = MessageLog(self.messages, self)
        self.region_dialog = SensorRegionDialog(self)
        self.status_line = StatusLine()
        self.controller = Controller(
            make_acquisition,
            start_up,
            controls=self.controls,
            camera_panel=self.camera_panel,
            recording_panel=self.recording_panel,
            region_dialog=self.region_dialog,
            messages=self.messages,
        )
        self.messages.reconnect_requested.connect(self._reconnect)
        self.guard = Guard(self.messages.alarm)
        self._analysis = BackgroundAnalysis(self.wavefront_panel, self.tabs, self.guard, self)
        for failed in (self._analysis.failed, self.wavefront_panel.refused, self.replay.failed):
            failed.connect(self.messages.warn)
        self.camera_panel.lenslet_clicked.connect(self.tabs.inspect)
        self.recording_bar = RecordingBar(self.controller, self.messages, settings)
        self.docks = lay_out(self)
        for field in self.findChildren(NumberField):
            field.refused.connect(self.messages.refuse)
        self.benches = BenchFiles(self, lambda bench: self.open(lambda: make_for(bench)), self.controller, settings)
        self.drop = FileDrop(self)
        fill_menus(self, window_menus(self), help_entries(self))
        if settings is not None:
            restore_state(settings, self)
        fit_to_screen(self)
        self._timer = QTimer(self)
        self._timer.setInterval(_REFRESH_INTERVAL_MS)
        self._timer.timeout.connect(self.guard(self.refresh))
        self._text_timer = QTimer(self)  # between two frames: together they would hold up the measurement
        self._text_timer.setInterval(_REFRESH_INTERVAL_MS // 2)
        self._text_timer.setSingleShot(True)
        self._text_timer.timeout.connect(self.guard(self.update_text))
        self.recording_panel.setEnabled(False)
        self.update_text()

    def connect_devices(self) -> None:
        """Open the devices and start measuring, also after a failure."""
        self._measurement, self._status, self._failure, self._activity = None, None, "", Activity("opening the devices")
        self.status_line.restart()
        self.controller.connect_devices()
        self.update_text()
        self._timer.start()

    def open(
        self, make_acquisition: Callable[[], Acquisition], begin: Begin = start_up, player: Player | None = None
    ) -> None:
        """Close the devices and connect others, also those of a `player`; `begin` sends the first commands.

        The user is asked first if a recording is under way, or the light must be switched off by hand.
        """

        def connect() -> None:
            self._timer.stop()
            self._text_timer.stop()
            self.controller.use(make_acquisition, begin, self._show_closing)
            self.recording_bar.refresh()  # the recording has ended
            self._forget_bench()
            self.replay.use(player)
            self.connect_devices()

        def ask_light_off() -> None:
            if not self.controller.light.ask_off(connect):
                connect()

        if not self.controller.ask_to_end_recording(ask_light_off):
            ask_light_off()

    def _forget_bench(self) -> None:
        self.guard.restart()
        self.camera_panel.forget()
        self.wavefront_panel.forget_bench()
        self.tabs.forget_bench()
        self._analysis.forget_bench()

    def refresh(self) -> None:
        """Show what has changed in the acquisition."""
        acquisition = self.controller.acquisition
        if acquisition is None:
            return
        controller = self.controller
        if any([controller.pending.poll(), controller.light.poll(), self._wanted != controller.settings.wanted]):
            self._status = None  # shown again, so that a refused value gives way to the one in force
        self._failure = acquisition.failure  # read once: message and buttons must agree
        self._activity = acquisition.activity  # before the status, which is that after a routine as soon as it ends
        status = acquisition.status
        if status is not None and self._failure:
            is_light_on = status.is_light_on and status.bench.has_manual_light
            status = replace(status, is_running=False, is_light_on=is_light_on)  # the state of failed devices
        if status is not None and status != self._status:
            self.show_status(status)
        is_ready = self._status is not None and not self._failure
        self.controls.setEnabled(is_ready)
        self.recording_panel.setEnabled(is_ready and self.replay.isHidden())
        self.messages.show_activity(self._activity, may_cancel=is_ready)
        self._refreshes += 1
        if self._failure:
            self.update_text()
        elif self._refreshes % _REFRESHES_PER_TEXT == 0:
            self._text_timer.start()  # before the frame is drawn: if that fails, the text says so
        measurement = acquisition.newest
        is_new = measurement is not self._measurement and not self.isMinimized()
        if measurement is not None and is_new and not self._late.leave_out(measurement, self._measurement):
            start_s = time.perf_counter()
            self.show_measurement(measurement)
            self.unpainted = measurement, acquisition.timings, time.perf_counter() - start_s

    def show_measurement(self, measurement: Measurement) -> None:
        """Show a frame and its wavefront, live or recorded."""
        is_first = self._measurement is None
        self._measurement = measurement
        wavefront = measurement.wavefront
        self.camera_panel.show_frame(measurement.frame, None if wavefront is None else wavefront.displacement)
        self.wavefront_panel.show_wavefront(wavefront)
        self._analysis.use_measurement(measurement)
        self.status_line.count(measurement)
        if is_first:
            self.update_text()
        self.measurement_shown.emit(measurement)

    def show_status(self, status: Status) -> None:
        """Show the state of the instrument."""
        self._status = status
        self._situation.follow(status)
        self.setWindowTitle(f"svwfs \N{EM DASH} {status.camera_name}")
        self._wanted = dict(self.controller.settings.wanted)
        self.controls.show_status(status, is_settled=self.controller.pending.is_empty, wanted=self._wanted)
        if self.controller.light.is_switching_off:
            self.controls.show_switching_off()
        self.replay.show_status(status)
        self.region_dialog.show_status(status)
        self._analysis.use_settings(status.bench.reconstruction)
        self.camera_panel.show_bench(status.bench.sensor, status.lattice, status.capabilities.full_scale)

    def update_text(self) -> None:
        """Update the numbers and the message."""
        self.wavefront_panel.update_text()
        acquisition, status, measurement = self.controller.acquisition, self._status, self._measurement
        if measurement is not None:
            statistics = frame_statistics(measurement.frame.pixels, self.camera_panel.full_scale)
            self.camera_panel.show_statistics(statistics)
            self.tabs.histogram.show_statistics(statistics)
            self.controls.show_brightness(statistics)
            show_automatic(self.controls.warp, self.controls.pupil_modes, measurement.wavefront)
        if measurement is not None and (now := self.controller.status) is not None:
            full_scale, temperature_c = now.capabilities.full_scale, now.temperature_c
            self.tabs.record(measurement, full_scale=full_scale, temperature_c=temperature_c)
        self.controller.show_recordings()
        self.recording_bar.refresh()
        self.status_line.update_text(status, acquisition.timings if acquisition else None)
        alarm = self._situation.alarm(status, self._activity, measurement)
        shown = liveness(status, self._failure, self._activity, measurement)
        self.camera_panel.show_liveness(shown)
        self.wavefront_panel.show_liveness(shown)
        self.tabs.lenslet.show_liveness(shown, self._failure or self._activity.text or alarm)
        self.messages.show_state(
            failure=self._failure,
            way_out=way_out(status),
            may_reconnect=not is_replay(status),
            warning="; ".join(filter(None, [alarm, self.replay.notice])),
            advice=advice(status, self._activity, measurement),
        )

    def save_screenshot(self, path: Path | None = None) -> bool:
        """Save a picture of the window, by default in the user's picture folder; return whether that succeeded."""
        return self.controller.save_screenshot(self.grab(), path)

    def changeEvent(self, event: QEvent | None) -> None:  # noqa: N802 - Qt's name
        """Draw the icons again in another theme."""
        super().changeEvent(event)
        if event is not None and event.type() == QEvent.Type.PaletteChange:
            self._status = None

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802 - Qt's name
        """Turn the light off at once; the window shows that it waits until the devices are closed."""
        if event is not None and (self._is_closing or event.spontaneous()):
            event.ignore()
            if not self._is_closing:
                self.quit()  # by the user
            return
        self._is_closing = True
        if self._settings is not None:
            save_state(self._settings, self)
        self._timer.stop()
        self._text_timer.stop()
        self._analysis.close()
        self.recording_bar.commands.close()
        self.region_dialog.close()
        self.controller.close(self._show_closing)
        self.recording_bar.refresh()  # name and note of a recording that was under way
        self._is_closing = False
        super().closeEvent(event)

    def _show_closing(self) -> None:
        """Paint what the window waits for, without taking any command."""
        acquisition = self.controller.acquisition
        for panel in (self.controls, self.recording_panel):
            panel.setEnabled(False)
        if acquisition is not None and acquisition.status is not None:
            self.show_status(replace(acquisition.status, is_running=False))
            self.messages.show_closing(light_when_closing(acquisition.status))
        QApplication.processEvents(QEventLoop.ProcessEventsFlag.ExcludeUserInputEvents)

    def quit(self) -> None:
        """Close the window; if a person switches the light, ask for that first."""
        if not self.controller.light.ask_off(lambda: QTimer.singleShot(0, self.close)):
            self.close()

    def _reconnect(self) -> None:
        if self.controller.failure:
            self.connect_devices()
