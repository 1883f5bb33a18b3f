"""Controller between the views and the acquisition: intents become commands, answers become messages."""

import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from PyQt6.QtCore import QStandardPaths
from PyQt6.QtGui import QPixmap

from app.acquisition.instrument import Instrument, Status
from app.acquisition.worker import Acquisition
from app.bench.config import write_bench
from app.cache import release_memory
from app.errors import InputError, RunError
from app.files import atomic_write
from app.gui.calibration_guide import CalibrationGuide
from app.gui.camera_panel import CameraPanel
from app.gui.controls_panel import ControlsPanel
from app.gui.light_control import LightControl
from app.gui.message_strip import MessageStrip
from app.gui.pending_commands import PendingCommands
from app.gui.picture_file import default_picture, write_picture
from app.gui.recording_panel import RecordingPanel
from app.gui.sensor_region_dialog import SensorRegionDialog
from app.gui.settings_control import SettingsControl
from app.gui.wording import area_taken, exposure_found, lattice_found, recording_ended
from app.measurement.averages import BackgroundCheck
from app.measurement.sensor_region import SensorArea, in_steps, region_around
from app.recording.recorder import Limit
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey

T = TypeVar("T")
Begin = Callable[[Acquisition], tuple[Future[Any], ...]]  # sends the first commands to an acquisition

_DISK_INTERVAL_S = 2.0  # between two queries of the free disk space
CLOSING_S = 45.0  # a frame of the slowest method takes up to half of it
_CLOSING_POLL_S = 0.04


class Controller:
    """Owns the acquisition, sends it what the views request, and shows its answers.

    There is no acquisition before `connect_devices`, and another one after each reconnection.
    """

    def __init__(
        self,
        make_acquisition: Callable[[], Acquisition] | None,
        begin: Begin,
        *,
        controls: ControlsPanel,
        camera_panel: CameraPanel,
        recording_panel: RecordingPanel,
        region_dialog: SensorRegionDialog,
        messages: MessageStrip,
    ) -> None:
        """Connect the views' intents; `begin` sends the first commands to each acquisition."""
        self._make_acquisition, self._begin = make_acquisition, begin
        self._camera_panel, self._recording_panel = camera_panel, recording_panel
        self._region_dialog, self._messages = region_dialog, messages
        self.acquisition: Acquisition | None = None
        self.pending = PendingCommands(messages)
        documents = QStandardPaths.writableLocation(QStandardPaths.StandardLocation.DocumentsLocation)
        self.recordings_folder = Path(documents or ".") / "svwfs"
        self.limit: Callable[[], Limit] = Limit  # of the next recording
        self.is_stuck = False  # whether the worker did not end on `close`
        self._on_accept: Callable[[], object] | None = None  # what an accepted question leads to
        self._starting: Future[None] | None = None  # the last start of a recording
        self._reported: set[Path] = set()  # recordings whose end was shown
        self._free_minutes, self._disk_due_s = math.inf, -math.inf
        self.light = LightControl(
            lambda: self.acquisition,
            self._send,
            self.ask,
            lambda: self.pending.is_done,
            controls=controls,
            messages=messages,
        )
        self.settings = SettingsControl(self._send, controls=controls, messages=messages)
        self._connect_routines(controls)

    @property
    def status(self) -> Status | None:
        """Status of the instrument; None until the devices are open."""
        return None if self.acquisition is None else self.acquisition.status

    @property
    def failure(self) -> str:
        """Reason why the acquisition ended by itself, else empty."""
        return "" if self.acquisition is None else self.acquisition.failure

    @property
    def error(self) -> InputError | RunError:
        """The failure as the error of a command."""
        error = None if self.acquisition is None else self.acquisition.error
        return error if isinstance(error, InputError | RunError) else RunError(self.failure)

    def use(self, make_acquisition: Callable[[], Acquisition], begin: Begin, meanwhile: Callable[[], object]) -> None:
        """Close the devices, as `close` does; use this factory at the next connection."""
        self.close(meanwhile)
        self._make_acquisition, self._begin = make_acquisition, begin

    def connect_devices(self) -> None:
        """Start an acquisition, if a bench is open; close the previous one first."""
        if self._make_acquisition is None:
            return
        if self.acquisition is not None:
            self.acquisition.close()
        self._propose(None)
        self.acquisition = self._make_acquisition()
        self.acquisition.start()
        self.settings.restart()
        self._starting = None
        self.pending.restart(self._begin(self.acquisition))
        release_memory()  # of the one before

    def close(self, meanwhile: Callable[[], object]) -> None:
        """Turn the light off at once and close the devices; wait for the worker, calling `meanwhile` at 25 Hz."""
        if self.acquisition is None:
            return
        self.acquisition.begin_close()
        deadline_s = time.monotonic() + CLOSING_S
        while self.acquisition.is_alive and time.monotonic() < deadline_s:
            self.acquisition.close(timeout_s=_CLOSING_POLL_S)
            meanwhile()
        self.is_stuck = self.acquisition.is_alive
        self.show_recordings()  # the end of one that was under way

    def ask_to_end_recording(self, then: Callable[[], object]) -> bool:
        """Return whether a recording is under way; then ask whether to end it, and call `then` if so."""
        state = None if self.acquisition is None else self.acquisition.recording
        if state is None or state.stage != "recording":
            return False
        question = f"the recording {state.folder.name} ends if another bench is opened"
        self.ask(question, then, "End it and open", "Keep recording")
        return True

    def check_background(self) -> None:
        """Compare the background with the dark."""

        def show(check: BackgroundCheck) -> None:
            (self._messages.inform if check.is_good else self._messages.warn)(check.verdict)

        self._send(lambda to: to.submit(Instrument.check_background), show)

    def save_screenshot(self, picture: QPixmap, path: Path | None) -> bool:
        """Save a picture, by default in the user's picture folder; return whether that succeeded."""
        try:
            write_picture(path := path or default_picture(), picture)
        except RunError as error:
            self._messages.warn(str(error))
            return False
        self._messages.inform(f"saved {path}")
        return True

    def save_bench(self, path: Path) -> bool:
        """Save the bench with the lattice and device settings in force; return whether that succeeded."""
        if self.status is None:
            return False
        try:
            with atomic_write(path) as temporary:
                temporary.write_text(write_bench(self.status.bench_in_force), "utf-8")
        except (InputError, RunError, ValueError) as error:  # ValueError: inconsistent settings
            self._messages.warn(str(error))
            return False
        self._messages.inform(f"saved {path}")
        return True

    def use_recordings_folder(self, folder: Path) -> None:
        """Write later recordings into another folder."""
        self.recordings_folder = folder
        self._messages.inform(f"recordings are saved in {folder}")

    def show_recordings(self) -> None:
        """Show the state of the recordings; report each end once."""
        acquisition = self.acquisition
        if acquisition is None:
            return
        if time.monotonic() > self._disk_due_s:
            self._disk_due_s = time.monotonic() + _DISK_INTERVAL_S
            try:
                self._free_minutes = acquisition.free_minutes(self.recordings_folder)
            except OSError:  # the start of a recording reports it
                self._free_minutes = math.inf
        is_starting = self._starting is not None and not self._starting.done()
        self._recording_panel.show_state(acquisition.recording, self._free_minutes, is_starting=is_starting)
        for state in (acquisition.recording, acquisition.kept):
            if state is not None and state.stage in {"finished", "ended early"} and state.folder not in self._reported:
                self._reported.add(state.folder)
                show = self._messages.alarm if state.stage == "ended early" else self._messages.inform
                show(recording_ended(state))

    def _connect_routines(self, controls: ControlsPanel) -> None:
        controls.auto_exposure_requested.connect(
            lambda: self._send(
                lambda to: to.submit(Instrument.auto_expose), lambda found: self._messages.inform(exposure_found(found))
            )
        )
        controls.lattice_requested.connect(
            lambda: self._send(lambda to: to.submit(Instrument.survey_lattice), self._propose)
        )
        window = self._region_dialog.parentWidget()
        self.guide = CalibrationGuide(self._send, lambda: self.status, self._use_lattice, self._cancel, window)
        self.light.end_sequence = self.guide.end_for_light
        controls.calibration_requested.connect(self.guide.begin)
        controls.sensor_region_requested.connect(self._open_region_dialog)
        self._region_dialog.area_requested.connect(
            lambda area: self._send(lambda to: to.set_area(area), self._show_area)
        )
        self._region_dialog.around_requested.connect(self._fill_around_lattice)
        self._recording_panel.record_requested.connect(self._record)
        self._recording_panel.keep_requested.connect(
            lambda: self._send(lambda to: to.keep_recent(self._new_folder("-kept"), may_rename=True))
        )
        self._messages.answered.connect(self._decide)
        self._messages.cancel_requested.connect(self._cancel)

    def _send(
        self,
        submit: Callable[[Acquisition], Future[T]],
        then: Callable[[T], object] | None = None,
        otherwise: Callable[[Exception], object] | None = None,
    ) -> None:
        """Send a command to the acquisition, if there is one; `then` receives the result, `otherwise` an error."""
        if self.acquisition is not None:
            self.pending.add(submit(self.acquisition), then, otherwise)

    def _cancel(self) -> None:
        if self.acquisition is not None:
            self.acquisition.cancel()

    def _propose(self, survey: Survey | None) -> None:
        self._camera_panel.propose(survey)
        if survey is not None:
            self.ask(lattice_found(survey), partial(self._use_lattice, survey.lattice))

    def ask(self, question: str, act: Callable[[], object], accept: str = "Use it", discard: str = "Discard") -> None:
        """Ask the user, and act if the answer is yes."""
        self._on_accept = act
        self._messages.ask(question, accept=accept, discard=discard)

    def _decide(self, is_accepted: bool) -> None:
        act, self._on_accept = self._on_accept, None
        self._propose(None)
        if act is not None and is_accepted:
            act()

    def _use_lattice(self, lattice: Lattice) -> None:
        self.settings.change(
            ("lattice", lattice), then=lambda _: self._messages.inform("the lattice is in use; Ctrl+S saves it")
        )

    def _open_region_dialog(self) -> None:
        status = self.status
        if status is None:
            return
        if status.capabilities.sensor is None and len(status.capabilities.binnings) == 1:
            self._messages.warn(f"{status.camera_name} always reads out its whole sensor and cannot bin")
        else:
            self._region_dialog.begin(status)

    def _fill_around_lattice(self) -> None:
        status = self.status
        if status is not None and status.lattice is not None and status.capabilities.sensor is not None:
            region = region_around(status.lattice, status.bench.sensor, status.area)
            self._region_dialog.fill(in_steps(region, status.capabilities.sensor, status.capabilities.region_step_px))

    def _show_area(self, area: SensorArea) -> None:
        self._region_dialog.close()  # returns the keys to the window
        if self.status is not None:
            text, is_whole = area_taken(self.status, area)
            (self._messages.inform if is_whole else self._messages.warn)(text)

    def _record(self, on: bool) -> None:
        acquisition = self.acquisition
        if acquisition is None:
            return
        if on:
            self._messages.alarm("")
            self._starting = acquisition.start_recording(self._new_folder(), limit=self.limit(), may_rename=True)
            self.pending.add(self._starting)
            if self.status is not None and not self.status.is_light_on:
                self._messages.warn("recording with the light off: L switches it on, W ends the recording")
        elif self._starting is None:  # begun elsewhere
            acquisition.stop_recording()
        elif not self._starting.cancel():
            self._starting.add_done_callback(lambda _: acquisition.stop_recording())  # at once if it has begun

    def _new_folder(self, suffix: str = "") -> Path:
        return self.recordings_folder / f"{datetime.now().astimezone():%Y%m%d-%H%M%S}{suffix}"
