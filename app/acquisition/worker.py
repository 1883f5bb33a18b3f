"""The acquisition: requests to the worker thread, and what it measured and recorded."""

import math
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from app.acquisition.instrument import Instrument
from app.acquisition.loop import AcquisitionLoop, Activity
from app.acquisition.without_sample import expose, find_lattice
from app.bench.config import write_bench
from app.measurement.auto_exposure import AutoExposure
from app.measurement.averages import BackgroundCheck
from app.measurement.measurement import FrameTotals, Measurement
from app.measurement.sensor_region import SensorArea
from app.progress import counted
from app.recording.recorder import Limit, RecordingState
from drivers.interface import Frame, WrongState
from reconstruction.lattice.search import Survey

T = TypeVar("T")

__all__ = ["Acquisition", "Activity", "FrameTotals", "Measurement"]


class Acquisition(AcquisitionLoop):
    """The acquisition loop with its routines and its recorder.

    Requests may come from any thread and return a future at once. A routine shows its progress as `activity`.
    """

    def take_dark(self, frames: int) -> Future[None]:
        """Average `frames` frames into the dark."""
        return self._routine(f"taking the dark, {counted(frames)}", Instrument.take_dark, frames)

    def take_reference(self, frames: int) -> Future[None]:
        """Average `frames` frames into the reference."""
        text = f"taking the reference, {counted(frames)}"
        return self._routine(text, Instrument.take_reference, frames)

    def auto_expose(self) -> Future[AutoExposure]:
        """Find and set exposure and current; a `RoutineError` says why there are none."""
        return self._routine("finding the exposure", Instrument.auto_expose)

    def find_lattice(self) -> Future[Survey]:
        """Find the lenslets in a few frames without the sample, without changing anything."""
        return self._routine("finding the lattice", find_lattice)

    def expose_without_sample(self) -> Future[AutoExposure]:
        """Find and set exposure and current for frames without the sample."""
        return self._routine("finding the exposure without the sample", expose)

    def check_background(self, frames: int = 8) -> Future[BackgroundCheck]:
        """Compare the background with the dark."""
        return self._routine(f"checking the background, {counted(frames)}", Instrument.check_background, frames)

    def set_area(self, area: SensorArea) -> Future[SensorArea]:
        """Read out another area of the sensor; see `Instrument.set_area`.

        Refused during a recording; the last seconds are dropped, since all frames of a recording have one size.
        """

        def command(instrument: Instrument) -> SensorArea:
            if self.recording is not None and self.recording.stage == "recording":
                raise WrongState("the region cannot change during a recording: stop the recording (W)")
            before, taken = SensorArea.of(instrument.devices.camera), instrument.set_area(area)
            if taken != before:
                self._recorder.forget_recent()
            return taken

        return self.submit(command)

    def show_single(self, choose: Callable[[Instrument], Frame], file: str = "") -> Future[None]:
        """Stop the camera, and reconstruct and publish the frame that `choose` returns, as if it came from there.

        `file` names the file that it is read from, if that is no recording.
        """

        def command(instrument: Instrument) -> None:
            frame = choose(instrument)  # may refuse: the camera goes on
            instrument.devices.camera.stop()
            self._path.process_single(frame, instrument, self._light(), file)

        return self.submit(command)

    def start_recording(
        self,
        folder: Path,
        *,
        command: str = "live",
        limit: Limit = Limit(),  # noqa: B008 - immutable
        may_rename: bool = False,
    ) -> Future[None]:
        """Record every frame from now on into a folder, until `stop_recording` or the `limit`.

        If the folder exists, `may_rename` chooses a new name beside it; `recording` tells which. The future has an
        `InputError` if the folder is not free or a recording is under way. Later failures, such as a full disk, end
        only the recording and are shown by `recording`.
        """
        return self.submit(
            lambda instrument: self._recorder.start(
                folder, _facts(instrument, command), limit=limit, may_rename=may_rename
            )
        )

    def limit_recording(self, limit: Limit) -> None:
        """Replace the limit of the current recording, if any."""
        self._recorder.limit(limit)

    def stop_recording(self) -> None:
        """End the current recording, if any; it is finished soon after."""
        self._recorder.stop()

    def keep_recent(self, folder: Path, *, command: str = "live", may_rename: bool = False) -> Future[None]:
        """Write the last ten seconds as a recording, even during another one; see `start_recording`."""
        return self.submit(
            lambda instrument: self._recorder.keep_recent(folder, _facts(instrument, command), may_rename=may_rename)
        )

    def free_minutes(self, folder: Path) -> float:
        """Recording time left in a folder at the current rate; see `Recorder.free_minutes`."""
        return self._recorder.free_minutes(folder)

    @property
    def recording(self) -> RecordingState | None:
        """State of the current or last recording; None before the first."""
        return self._recorder.state

    @property
    def kept(self) -> RecordingState | None:
        """State of the recording that `keep_recent` writes or wrote last."""
        return self._recorder.kept_state

    def _routine(self, text: str, routine: Callable[..., T], *arguments: int) -> Future[T]:
        def show_progress(frame: Frame, fraction: float) -> None:
            self.activity = Activity(text, fraction)
            self._path.show(frame, text, self._light())

        def command(instrument: Instrument) -> T:
            def should_stop() -> bool:
                self._poll_status(instrument)  # the light and the sample differ from before
                return self._stopping.is_set() or self._cancelling.is_set()

            self._cancelling.clear()
            self._status_due_s = -math.inf
            self.activity = Activity(text)
            self._path.gap_cause = text
            return routine(instrument, *arguments, progress=show_progress, should_stop=should_stop)

        return self.submit(command)


def _facts(instrument: Instrument, command: str) -> dict[str, Any]:
    """Origin of a recording, stored with it."""
    return {"command": command, "bench": write_bench(instrument.bench), "devices": instrument.properties()}
