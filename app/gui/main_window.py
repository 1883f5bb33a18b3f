"""The window: panels that show and ask, and the controller between them and the acquisition.

One timer looks at the acquisition 25 times a second: the newest measurement, the status, the activity, the failure.
Whatever the user wants becomes a command that the acquisition's worker executes between two frames.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path

from PyQt6.QtCore import Qt, QTimer, pyqtSignal
from PyQt6.QtGui import QCloseEvent
from PyQt6.QtWidgets import QSplitter, QVBoxLayout, QWidget

from app.acquisition.instrument import Status
from app.acquisition.start_up import FRAMES, start_up
from app.acquisition.worker import Acquisition, Activity, Measurement
from app.errors import InputError, RunError
from app.gui.advice import advice, warning
from app.gui.analysis import Quantity
from app.gui.analysis_panel import AnalysisPanel
from app.gui.answers import Answers
from app.gui.calibration_control import CalibrationControl
from app.gui.camera_panel import CameraPanel
from app.gui.controls_panel import ControlsPanel
from app.gui.live_analysis import LiveAnalysis
from app.gui.menu import fill_menus
from app.gui.message_strip import MessageStrip
from app.gui.orders import Orders, connect_controls
from app.gui.read_out_control import ReadOutControl
from app.gui.recording_control import RecordingControl
from app.gui.recording_panel import RecordingPanel
from app.gui.saving import save_bench, save_screenshot
from app.gui.status_line import StatusLine
from app.gui.timed_window import TimedWindow
from app.gui.wavefront_panel import WavefrontPanel

_LOOK_INTERVAL_MS = 40
_LOOKS_PER_TEXT = 5  # numbers that change more often than five times a second cannot be read
_LEAST_WIDTH = 900  # px; narrower, and captions and plots have no room
_CLOSING_S = 45.0  # a frame of the slowest method takes up to half of it; the light is on until then


class MainWindow(TimedWindow):
    """The window of `svwfs live`."""

    measurement_shown = pyqtSignal(object)  # the Measurement, a reference to it only

    def __init__(
        self,
        make_acquisition: Callable[[], Acquisition],
        *,
        begin: Callable[[Acquisition], tuple[Future[None], ...]] = start_up,
    ) -> None:
        """Show nothing yet; `connect_devices` makes an acquisition, starts it and has it `begin`."""
        super().__init__()
        self._make_acquisition, self._begin = make_acquisition, begin
        self._measurement: Measurement | None = None
        self._status: Status | None = None
        self._looks = 0
        self.is_stuck = False  # whether a device kept the worker from ending when the window was closed

        self.camera_panel = CameraPanel()
        self.wavefront_panel = WavefrontPanel()
        self.analysis_panel = AnalysisPanel()
        self.controls = ControlsPanel(FRAMES)
        self.recording_panel = RecordingPanel()
        self.messages = MessageStrip()
        self._answers = Answers(self.messages)
        self._orders = Orders(self._answers)
        self.recording = RecordingControl(self.recording_panel, self.messages, self._answers)
        self._calibration = CalibrationControl(self.camera_panel, self.messages, self._answers)
        self.read_out = ReadOutControl(self.messages, self._answers, self)
        self.status_line = StatusLine()
        self._analysis = LiveAnalysis(self.wavefront_panel, self.analysis_panel, self)
        self._analysis.failed.connect(self.messages.warn)
        self._lay_out()
        self._connect_intents()
        self._fill_menus()
        self._timer = QTimer(self)
        self._timer.setInterval(_LOOK_INTERVAL_MS)
        self._timer.timeout.connect(self.look)

    @property
    def _acquisition(self) -> Acquisition | None:
        return self._orders.acquisition

    @property
    def _activity(self) -> Activity:
        return Activity() if self._acquisition is None else self._acquisition.activity

    @property
    def failure(self) -> str:
        """Why the acquisition has ended, when nobody asked it to."""
        return "" if self._acquisition is None else self._acquisition.failure

    @property
    def error(self) -> InputError | RunError:
        """The failure as the error that a command ends with."""
        error = None if self._acquisition is None else self._acquisition.error
        return error if isinstance(error, InputError | RunError) else RunError(self.failure)

    def connect_devices(self) -> None:
        """Open the devices, again if they were open before, and begin to measure."""
        if self._acquisition is not None:
            self._acquisition.close()
        self._measurement, self._status = None, None
        self._calibration.forget()
        self.status_line.restart()
        acquisition = self._orders.acquisition = self._make_acquisition()
        acquisition.start()
        self._answers.restart(self._begin(acquisition))
        self._timer.start()

    def look(self) -> None:
        """Show what is new."""
        acquisition = self._acquisition
        if acquisition is None:
            return
        if self._answers.look():
            self._status = None  # shown again, so that a refused value gives way to the one in force
        status = acquisition.status
        if status is not None and acquisition.failure:
            status = replace(status, is_running=False, is_light_on=False)  # this is how failing devices are left
        if status is not None and status != self._status:
            self.show_status(status)
        is_ready = self._status is not None and not acquisition.failure
        self.controls.setEnabled(is_ready)
        self.recording_panel.setEnabled(is_ready)
        self.messages.show_activity(acquisition.activity, may_cancel=is_ready and bool(acquisition.activity.text))
        measurement = acquisition.newest
        if measurement is not None and measurement is not self._measurement and not self.isMinimized():
            with self.drawing(measurement, acquisition.timings):
                self.show_measurement(measurement)
        self._looks += 1
        if self._looks % _LOOKS_PER_TEXT == 0 or acquisition.failure:
            self.update_text()

    def show_measurement(self, measurement: Measurement) -> None:
        """Show a frame and its wavefront; nothing else is needed for it, so a recorded one will do."""
        is_first = self._measurement is None
        self._measurement = measurement
        wavefront = measurement.wavefront
        self.camera_panel.show_frame(measurement.frame, None if wavefront is None else wavefront.displacement)
        self.wavefront_panel.show_wavefront(wavefront)
        self._analysis.show_wavefront(wavefront)
        self.status_line.count(measurement)
        if is_first:
            self.update_text()
        self.measurement_shown.emit(measurement)

    def show_status(self, status: Status) -> None:
        """Show how the instrument stands."""
        self._status = status
        self.setWindowTitle(f"svwfs \N{EM DASH} {status.camera_name}")
        self.controls.show_status(status, is_settled=self._answers.are_all_there)
        self.read_out.dialog.show_status(status)
        self._analysis.show_bench(status.bench)
        self.camera_panel.show_running(is_running=status.is_running)
        self.camera_panel.show_bench(status.bench.sensor, status.lattice, status.capabilities.full_scale)

    def update_text(self) -> None:
        """Write the numbers and the message."""
        self.camera_panel.update_text()
        self.wavefront_panel.update_text()
        if self._acquisition is not None:
            self.recording.show(self._acquisition)
        timings = None if self._acquisition is None else self._acquisition.timings.summary()
        self.status_line.update_text(self._status, timings)
        status, measurement = self._status, self._measurement
        is_live = status is not None and status.is_running and not self._activity.text
        problem = measurement.problem if is_live and measurement is not None else ""
        self.messages.show_state(
            failure=self.failure,
            warning="" if status is None or self._activity.text else warning(status, problem),
            advice=advice(status, self._activity, measurement),
        )

    def save_screenshot(self, path: Path | None = None) -> bool:
        """Save a picture of the window, in the user's picture folder unless told otherwise; return whether it was."""
        return save_screenshot(self, self.messages, path)

    def save_bench(self) -> None:
        """Save the bench as it is set now, the lattice in force included."""
        if self._status is not None:
            save_bench(self, self.messages, self._status.bench_in_force)

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802 - Qt's name
        """Turn the light off and let go of the devices."""
        self._timer.stop()
        self._analysis.close()
        self.hide()
        if self._acquisition is not None:
            self._acquisition.close(timeout_s=_CLOSING_S)
            self.is_stuck = self._acquisition.is_alive
        super().closeEvent(event)

    def _lay_out(self) -> None:
        self.setWindowTitle("svwfs")
        self.resize(1440, 900)
        left = QSplitter(Qt.Orientation.Vertical)
        left.addWidget(self.camera_panel)
        left.addWidget(self.analysis_panel)
        left.setSizes([1000, 450])
        left.setHandleWidth(10)
        left.setChildrenCollapsible(False)
        images = QSplitter(Qt.Orientation.Horizontal)
        images.addWidget(left)
        images.addWidget(self.wavefront_panel)
        images.setSizes([1000, 1000])
        images.setHandleWidth(16)
        framed = QVBoxLayout()  # a splitter forgets its own margins when it is asked how small it can be
        framed.setContentsMargins(10, 8, 10, 6)
        framed.addWidget(images)
        body = QWidget()
        layout = QVBoxLayout(body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(4)
        layout.addStrut(_LEAST_WIDTH)  # a larger font may need more, which the layout knows
        layout.addLayout(framed, 1)
        layout.addWidget(self.messages)
        layout.addWidget(self.controls)
        layout.addWidget(self.status_line)
        self.setCentralWidget(body)
        if (bar := self.menuBar()) is not None:
            bar.setNativeMenuBar(False)  # another place would leave no corner
            bar.setCornerWidget(self.recording_panel)

    def _fill_menus(self) -> None:
        controls, camera = self.controls, self.camera_panel
        fill_menus(
            self,
            {
                "&File": (
                    ("Record, or stop recording", "W", self.recording_panel.record.click),
                    ("Keep the last seconds", "K", self.recording_panel.keep.click),
                    ("Where recordings go", "Ctrl+O", lambda: self.recording.choose_folder(self)),
                    ("Save the bench", "Ctrl+S", self.save_bench),
                    ("Save a screenshot", "Ctrl+P", self.save_screenshot),
                    ("Quit", "Ctrl+Q", self.close),
                ),
                "&Bench": (
                    ("Start or stop the camera", "Space", controls.start.click),
                    ("Switch the light", "L", controls.light.click),
                    ("Move the sample in or out", "S", controls.sample.click),
                    ("Take a dark", "D", controls.dark.click),
                    ("Take a reference", "R", controls.reference.click),
                    ("Find the lattice in the reference", "N", controls.lattice.click),
                    ("Find the exposure", "X", controls.auto_exposure.click),
                    ("Compare the background with the dark", "B", self._orders.to(self._calibration.check_background)),
                    ("Use what is proposed", "Return", self.messages.enter),
                    ("Cancel what is under way, or discard", "Esc", self.messages.escape),
                    ("Refine, or not", "F", controls.refine.click),
                    ("Set the exposure", "E", controls.exposure.edit),
                    ("Set the current", "C", controls.current.edit),
                    ("Read out a part of the sensor, or bin it", "P", controls.read_out.click),
                    ("Reconnect after a failure", "Ctrl+R", self.messages.reconnect.click),
                ),
                "&View": (
                    ("Lattice", "G", camera.lattice_toggle.toggle),
                    ("Arrows", "A", camera.arrows_toggle.toggle),
                    ("Hold the colour scale", "H", self.wavefront_panel.hold_scale.toggle),
                    ("MTF and isoplanatism", "I", self._toggle_analysis),
                    ("Time of every stage", "T", self.status_line.timing_row.toggle),
                    *(
                        (f"{quantity} over the field", str(index + 1), partial(self.wavefront_panel.choose, quantity))
                        for index, quantity in enumerate(Quantity)
                    ),
                ),
            },
        )

    def _toggle_analysis(self) -> None:
        self.analysis_panel.setVisible(not self.analysis_panel.isVisible())

    def _connect_intents(self) -> None:
        controls, to = self.controls, self._orders.to
        connect_controls(controls, self._orders)
        controls.lattice_requested.connect(to(self._calibration.survey))
        controls.auto_exposure_requested.connect(to(self._calibration.auto_expose))
        controls.read_out_requested.connect(lambda: self.read_out.open(self._status))
        self.read_out.dialog.wanted.connect(lambda area: to(self.read_out.read_out, area=area)())
        self.recording_panel.record_requested.connect(
            lambda on: to(self.recording.start if on else self.recording.stop)()
        )
        self.recording_panel.keep_requested.connect(to(self.recording.keep))
        self.messages.answered.connect(lambda is_wanted: to(self._calibration.answer, is_wanted=is_wanted)())
        self.messages.cancel_requested.connect(to(Acquisition.cancel))
        self.messages.reconnect_requested.connect(self._reconnect)

    def _reconnect(self) -> None:
        if self.failure:
            self.connect_devices()
