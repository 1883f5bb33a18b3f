"""The instrument: devices, dark, reference and the estimator made of them.

It lives in the thread that owns the devices. Its public methods are the requests of window, commands and scripts, and
take and return plain data; other threads see its frozen `Status`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, fields, replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, Concatenate, Literal, ParamSpec, Self, TypeAlias, TypeVar

from app.acquisition.dark_reference_store import AverageState, DarkReferenceStore
from app.acquisition.watchdog_light import WatchdogLight
from app.bench.config import Bench, changes_in_words, with_known, write_bench
from app.bench.settings_schema import fits
from app.measurement.auto_exposure import AutoExposure, auto_expose
from app.measurement.averages import Average, BackgroundCheck, check_background, take_dark, take_reference
from app.measurement.background_estimator import LiveEstimator
from app.measurement.calibration import Calibration, surveyed
from app.measurement.estimator import Estimator, mask_sentence
from app.measurement.linearity import measure_linearity
from app.measurement.measurement import SKIPPED, Assumptions, Measurement
from app.measurement.routines import NO_CALLBACKS, AcquisitionSettings, RoutineCallbacks, RoutineError, restored
from app.measurement.sensor_region import SensorArea, moved_bench, moved_lattice, set_area
from app.progress import counted
from app.recording.playback_devices import RecordedLight
from app.recording.recorder import NO_LIMIT, Recorder, RecordingLimit
from app.timing import Timings
from drivers.interface import BadValue, CameraCapabilities, Devices, Frame, Property, Range, WrongState, switched
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError, UnusableSettings
from reconstruction.frame.linearity_fit import MeasuredLinearity
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.runtime.child_process import Child, Condition, condition_of

P = ParamSpec("P")
T = TypeVar("T")

WINDOW = "live"  # command of the recordings of a window, and of those that name none
_LATTICE_FRAMES = 4  # averaged to find the lattice
_BACKGROUND_FRAMES = 8  # averaged to check the background

ProcessName: TypeAlias = Literal["instrument", "watchdog", "background estimator"]


@dataclass(frozen=True, slots=True)
class ProcessState:
    """A process of an instrument, by its name and id."""

    name: ProcessName
    pid: int
    condition: Condition

    @classmethod
    def of(cls, name: ProcessName, process: Child) -> Self:
        """Look at a process that this one has started."""
        return cls(name, process.pid, condition_of(process))


@dataclass(frozen=True, slots=True)
class Status(AcquisitionSettings):
    """Snapshot of the instrument, with the settings in force."""

    bench: Bench
    camera_name: str
    light_name: str
    capabilities: CameraCapabilities
    is_running: bool
    current_range_a: Range
    current_a: float
    is_light_on: bool
    masks: tuple[str, ...]
    is_sample_in: bool
    is_replay: bool  # a recording plays in place of the devices
    dark: AverageState
    reference: AverageState
    lattice: Lattice | None
    warning: str  # why wavefronts are missing or doubtful; empty if they are good
    mask_note: str = ""  # which deformations the mask hides; empty if it shows all
    method: str = ""  # of the registration, as the settings or the reference have chosen it; empty without a reference
    is_calibrated: bool = False  # frames can be reconstructed
    has_background_estimator: bool = False  # of layers or a correction, which the first frames show
    processes: tuple[ProcessState, ...] = ()  # that were started for it
    temperature_c: float | None = field(default=None, compare=False)  # of the camera's sensor; None if unknown

    @property
    def area(self) -> SensorArea:
        """The area of the sensor that is read out."""
        return SensorArea(self.region, self.binning)

    @property
    def bench_in_force(self) -> Bench:
        """The bench with the current lattice, exposure, gain and light current."""
        camera: dict[str, object] = {"exposure_s": self.exposure_s, "em_gain": self.em_gain}
        if not self.is_replay:  # of which only the recorded bench knows the mode
            camera |= {"amplifier": self.amplifier, "readout_speed": self.readout_speed}
        return replace(
            self.bench,
            lattice=self.lattice,
            camera=with_known(self.bench.camera, camera),
            light=with_known(self.bench.light, {"current_a": self.current_a}),
        )


@dataclass(frozen=True, slots=True)
class Activity:
    """Work other than taking frames, with its progress; empty text if there is none."""

    text: str = ""
    progress: float = 0.0
    may_cancel: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class _Replaced:
    """State before the last dark, reference or change of the bench."""

    by: str  # what has replaced it
    bench: Bench
    lattice: Lattice | None
    darks: DarkReferenceStore
    references: DarkReferenceStore


class Instrument:
    """Devices with their dark, reference and estimator."""

    def __init__(
        self,
        devices: Devices,
        bench: Bench,
        *,
        recorder: Recorder | None = None,
        timings: Timings | None = None,
        show_preparation: Callable[[str], object] = lambda _: None,
        callbacks: Callable[[Instrument, str], RoutineCallbacks] = lambda _, __: NO_CALLBACKS,
    ) -> None:
        """`show_preparation` receives what takes seconds to prepare, and why; `callbacks` are those of a routine."""
        self.devices, self._show_preparation, self._callbacks = devices, show_preparation, callbacks
        self._timings = timings or Timings()
        self._recorder = recorder or Recorder(self._timings)
        self.bench = bench  # with the current settings
        self.darks = DarkReferenceStore("dark", is_lit=False)
        self.references = DarkReferenceStore("reference", is_lit=True)
        self._modes: dict[tuple[str, int], tuple[float, float]] = {}  # exposure and gain by amplifier and speed
        self._lattice = bench.lattice
        self._replaced: _Replaced | None = None
        self._estimator: Estimator | None = None  # None if frames cannot be reconstructed
        self._solver: LiveEstimator | None = None
        self._before: Displacement | None = None  # displacement of the previous frame
        self._previous: Frame | None = None
        self._search_problem = ""  # why layers and corrections grow old, as last polled
        self._is_of_settings = False  # whether they are the problem, and neither dark nor reference
        self._problem = self.references.doubt(self._now())

    def properties(self) -> dict[str, dict[str, Property]]:
        """All properties of the devices, for a recording."""
        return {name: getattr(self.devices, name).properties() for name in ("camera", "light", "stage")}

    def processes(self) -> tuple[ProcessState, ...]:
        """State of the processes that were started for it."""
        light, solver = self.devices.light, self._solver
        started: dict[ProcessName, Child | None] = {
            "watchdog": light.watchdog if isinstance(light, WatchdogLight) else None,
            "background estimator": None if solver is None else solver.process,
        }
        return tuple(ProcessState.of(name, process) for name, process in started.items() if process is not None)

    def status(self) -> Status:
        """Query the devices."""
        camera, light, stage = self.devices.camera, self.devices.light, self.devices.stage
        now, estimator = self._now(), self._estimator
        problem = self._problem if estimator is None else ""
        of_dark, of_reference = self.darks.doubt(now), self.references.doubt(now)
        judged = Quality() if estimator is None else estimator.quality_checker.of_reference
        of_reference = of_reference or judged.reasons.get(Fault.CLIPPED, "")  # its other faults are warnings
        blamed = "" if self._is_of_settings else problem
        self._search_problem = "" if self._solver is None else self._solver.problem
        sensor, bench = self.bench.sensor, self.bench
        if estimator is not None:
            rows, columns = estimator.reconstructor.sensor.lenslets
            bench = replace(bench, sensor=replace(sensor, lenslet_rows=rows, lenslet_columns=columns))
        is_counted = None not in {bench.sensor.lenslet_rows, bench.sensor.lenslet_columns}
        return Status(
            **{each.name: getattr(now, each.name) for each in fields(now)},
            bench=bench,
            camera_name=camera.name,
            light_name=light.name,
            capabilities=camera.capabilities,
            is_running=camera.is_running,
            current_range_a=light.current_range_a,
            current_a=light.current_a,
            is_light_on=light.is_on,
            masks=stage.masks,
            is_sample_in=stage.is_sample_in,
            is_replay=isinstance(light, RecordedLight),
            dark=self.darks.state(of_dark),
            reference=self.references.state(blamed or of_reference),
            lattice=self._lattice if is_counted else None,
            warning=light.off_reason or problem or of_dark or of_reference or self._search_problem or judged.sentence,
            mask_note="" if estimator is None else mask_sentence(estimator.reconstructor),
            method="" if estimator is None else estimator.reconstructor.registration.method,
            is_calibrated=estimator is not None,
            has_background_estimator=self._solver is not None and self._solver.has_background_estimator,
            processes=self.processes(),
            temperature_c=camera.temperature_c,
        )

    def set_running(self, is_running: bool) -> None:
        """Start or stop the camera, unless it is so already."""
        if not switched(is_running):
            self.devices.camera.stop()
        elif not self.devices.camera.is_running:
            self.devices.camera.start()

    def set_exposure_s(self, exposure_s: float) -> float:
        """Change the exposure time; return the one in force."""
        return self.devices.camera.set_exposure(exposure_s)

    def set_em_gain(self, em_gain: float) -> float:
        """Change the electron multiplication; return the one in force."""
        return self.devices.camera.set_em_gain(em_gain)

    def set_amplifier(self, amplifier: str) -> str:
        """Change the amplifier; return in words what else has changed."""
        return self._set_mode(partial(self.devices.camera.set_amplifier, amplifier))

    def set_readout_speed(self, readout_speed: int) -> str:
        """Change the readout speed; return in words what else has changed."""
        return self._set_mode(partial(self.devices.camera.set_readout_speed, readout_speed))

    def set_current_a(self, current_a: float) -> float:
        """Change the current of the light; return the one in force."""
        return self.devices.light.set_current(current_a)

    def set_light_on(self, is_on: bool) -> None:
        """Switch the light, or note that a person has switched a manual one."""
        self.devices.light.note_light(is_on)

    def set_sample_in(self, is_in: bool) -> None:
        """Move the sample, or note that a person has moved it."""
        self.devices.stage.note_sample(is_in)

    def take_dark(self, frames: int) -> None:
        """Average frames with the light off, and use them as dark from now on."""
        callbacks = self._callbacks(self, f"taking the dark, {counted(frames)}")
        taken = take_dark(self.devices, frames, callbacks)
        self._remember("the new dark")
        self.darks.keep(taken, self._now())
        self._prepare("with the new dark")

    def take_reference(self, frames: int) -> None:
        """Average frames without the sample into the reference, and find the lattice if unknown."""
        callbacks = self._callbacks(self, f"taking the reference, {counted(frames)}")
        taken = take_reference(self.devices, frames, callbacks)
        self._remember("the new reference")
        self.references.keep(taken, self._now())
        self._prepare("with the new reference; after an installation, its compilation takes half a minute")

    def use(self, calibration: Calibration) -> None:
        """Replace bench, dark and reference, for example by recorded ones."""
        self.bench, now, self._replaced = calibration.bench, self._now(), None
        self.darks.use_recorded(calibration.dark, now)
        self.references.use_recorded(calibration.reference, now)
        self._prepare("with the recorded calibration")

    def auto_expose(self, *, without_sample: bool = False) -> AutoExposure:
        """Find and set exposure and current for the light in the beam; `RoutineError` if there are none."""
        callbacks = self._callbacks(self, "finding the exposure" + " without the sample" * without_sample)
        with restored(self.devices) as state:
            if without_sample:  # of which the reference is made
                self.devices.stage.set_sample_in(False)
            found = auto_expose(self.devices, self._pitch_px, callbacks)
            state.exposure_s, state.current_a = found.exposure_s, found.current_a
            return found

    def check_background(self) -> BackgroundCheck:
        """Compare the current background with the dark; `RoutineError` if there is no dark that fits."""
        callbacks = self._callbacks(self, f"checking the background, {counted(_BACKGROUND_FRAMES)}")
        doubt, dark = self.darks.doubt(self._now()), self.darks.average
        if dark is None or doubt:
            raise RoutineError(doubt)
        return check_background(self.devices, dark, _BACKGROUND_FRAMES, callbacks)

    def find_lattice(self) -> Survey:
        """Find the lenslets in a few frames without the sample, without changing anything."""
        callbacks = self._callbacks(self, "finding the lattice")
        return self._survey(take_reference(self.devices, _LATTICE_FRAMES, callbacks))

    def survey_lattice(self) -> Survey:
        """Find the lenslets in the reference without changing anything."""
        reference = self.references.fitting(self._now())
        if reference is None:
            raise WrongState(self.references.doubt(self._now()))
        return self._survey(reference)

    def measure_linearity(self, frames: int) -> MeasuredLinearity:
        """Measure the camera's nonlinearity in exposures of `frames` frames, changing nothing."""
        callbacks = self._callbacks(self, "measuring the camera's nonlinearity")
        return measure_linearity(self.devices, self._pitch_px, frames, callbacks)

    def set_area(self, area: SensorArea) -> SensorArea:
        """Read out another area of the sensor, the camera paused; return the area that the camera accepted.

        The lattice moves with it. Dark and reference become unusable until they are retaken or the area is restored.
        Refused during a recording; the last seconds are dropped, since all frames of a recording have one size.
        """
        self._recorder.require_none("the region cannot change during a recording: stop the recording (W)")
        camera, before = self.devices.camera, SensorArea.of(self.devices.camera)
        whole = camera.capabilities.sensor
        with camera.paused():
            taken = set_area(camera, area)
            try:
                bench = moved_bench(self.bench, before, taken, whole)
                lattice = None if self._lattice is None else moved_lattice(self._lattice, before, taken)
            except BadValue:
                set_area(camera, before)
                raise
        if taken != before:
            self.bench, self._lattice, self._replaced = bench, lattice, None
            self._prepare("for the new region")
            self._recorder.forget_recent()
        return taken

    def change_settings(self, changes: Sequence[tuple[str, Any]], mask: str | None = None) -> None:
        """Change registration, reconstruction or lattice, and the mask, whose own reference is used again.

        Each change is "section" or "section.key" with its value, or "lenslets" with the arguments of
        `Bench.with_excluded`.
        """
        before = self.bench
        try:
            after = _changed(before, changes)
        except (ValueError, TypeError, AttributeError) as error:  # inconsistent, or of another program
            raise BadValue(str(error)) from error
        if mask is not None:
            self.devices.stage.set_mask(mask)  # may refuse: nothing changes
        if after != before:
            self._remember(changes_in_words(before, after))
        self.bench = after
        self._prepare(f"{'' if mask is None else f'for the mask {mask}, '}with {changes_in_words(before, after)}")

    def undoable(self) -> tuple[str, str]:
        """Return what `undo` takes back, and how the dark or reference that returns was taken."""
        before = self._last_replaced()
        returning = {"the new dark": before.darks, "the new reference": before.references}.get(before.by)
        return before.by, "" if returning is None else returning.state("").how

    def undo(self) -> str:
        """Restore what the last dark, reference or change of the bench replaced; again, and that returns.

        Return what was taken back; `WrongState` if nothing was replaced.
        """
        before = self._last_replaced()
        self._remember(before.by)
        self.bench, self._lattice = before.bench, before.lattice
        self.darks, self.references = before.darks, before.references
        self._prepare(f"as before {before.by}")
        return before.by

    def _last_replaced(self) -> _Replaced:
        if self._replaced is None:
            raise WrongState("there is nothing to undo: no dark, reference or bench was replaced")
        return self._replaced

    def _remember(self, by: str) -> None:
        self._replaced = _Replaced(by, self.bench, self._lattice, copy(self.darks), copy(self.references))

    def start_recording(
        self, folder: Path, *, command: str = WINDOW, limit: RecordingLimit = NO_LIMIT, may_rename: bool = False
    ) -> None:
        """Record every frame from now on into a folder, until `stop_recording` or the `limit`.

        If the folder exists, `may_rename` chooses a new name next to it; `recording` says which. `InputError` if the
        folder is not free or a recording is under way. Later failures, such as a full disk, end only the recording and
        are shown by `recording`.
        """
        self._recorder.start(folder, self._facts(command), limit=limit, may_rename=may_rename)

    def keep_recent(self, folder: Path, *, may_rename: bool = False) -> None:
        """Write the last ten seconds as a recording, even during another one; see `start_recording`."""
        self._recorder.keep_recent(folder, self._facts(WINDOW), may_rename=may_rename)

    def _facts(self, command: str) -> dict[str, Any]:
        return {"command": command, "bench": write_bench(self.bench), "devices": self.properties()}

    @property
    def calibration(self) -> Calibration | None:
        """The calibration in force; None if frames cannot be reconstructed."""
        return None if self._estimator is None else self._estimator.calibration

    def measure(self, frame: Frame) -> Measurement:
        """Reconstruct a frame, or say why that is impossible."""
        previous, self._previous = self._previous, frame
        if self._estimator is None or self._solver is None:
            return Measurement(frame, None, self._problem)
        solve = partial(self._solver.solve, time_s=frame.camera_time_s)
        start, absorbs = self._before, self._solver.absorbs
        made = self._estimator.measure(frame, solve, self._timings, start=start, absorbs=absorbs, previous=previous)
        self._before = made.registered or self._before
        if made.wavefront is None or not self._search_problem:
            return made
        return replace(made, quality=made.quality | Quality.of(Fault.SEARCH, self._search_problem))

    def measure_single(self, frame: Frame, *, is_foreign: bool) -> Measurement:
        """Reconstruct a frame that is not live; see `LiveEstimator.solve_single`."""
        if self._estimator is None or self._solver is None:
            return Measurement(frame, None, self._problem)
        solve = partial(self._solver.solve_single, is_foreign=is_foreign)
        return self._estimator.measure(frame, solve, self._timings)

    def skip(self, frame: Frame) -> Measurement:
        """Skip a frame, keeping calibration and assumptions for a later reconstruction."""
        self._previous = frame
        assumed = Assumptions() if self._solver is None else self._solver.as_before(frame.camera_time_s)
        return Measurement(frame, None, SKIPPED, calibration=self.calibration, assumed=assumed)

    def close(self) -> None:
        """Stop the thread of the solver; the caller closes the devices."""
        if self._solver is not None:
            self._solver.close()
        self._solver = None

    def _now(self) -> AcquisitionSettings:
        return AcquisitionSettings.of(self.devices)

    def _set_mode(self, change: Callable[[], object]) -> str:
        """Change a mode of the camera, restore the exposure and gain last used in it; say what changed."""
        camera = self.devices.camera
        exposure_s, em_gain = self._modes[camera.amplifier, camera.readout_speed] = camera.exposure_s, camera.em_gain
        with camera.paused():
            change()
            if known := self._modes.get((camera.amplifier, camera.readout_speed)):
                with suppress(BadValue):  # the region may have changed the limits
                    camera.set_exposure(known[0])
                    camera.set_em_gain(known[1])
        changes = (
            ("exposure", exposure_s * 1e3, camera.exposure_s * 1e3, " ms"),
            ("gain", em_gain, camera.em_gain, ""),
        )
        return ", ".join(
            f"{what} changed from {before:.4g} to {after:.4g}{unit}"
            for what, before, after, unit in changes
            if f"{before:.4g}" != f"{after:.4g}"
        )

    @property
    def _pitch_px(self) -> float:
        return self.bench.sensor.lenslet_pitch_px if self._lattice is None else self._lattice.pitch_px

    def _survey(self, reference: Average) -> Survey:
        """Find the lenslets in a reference of the current region; `ReconstructionError` if it shows none."""
        self._show_preparation("finding the lattice")
        dark = self.darks.fitting(self._now())
        return surveyed(self.bench.sensor, reference, dark=dark, full_scale=self.devices.camera.capabilities.full_scale)

    def _prepare(self, cause: str) -> None:
        """Prepare the estimator again, the camera paused; a failure becomes the warning in the status."""
        self._estimator = self._before = None
        self._problem = "the reconstruction could not be prepared: take the reference again"
        self.close()
        camera, bench, now = self.devices.camera, self.bench, self._now()
        dark, reference = (averages.choose(now) for averages in (self.darks, self.references))
        if reference is None:
            self._problem, self._is_of_settings = self.references.doubt(now), False
            return
        self._show_preparation(f"preparing the reconstruction {cause}")
        try:
            with camera.paused():
                full_scale = camera.capabilities.full_scale
                estimator = Estimator(Calibration.of(bench, reference, dark=dark, full_scale=full_scale))
                self._lattice = estimator.calibration.lattice
                _ = estimator.quality_checker  # prepared before the first frame
                self._solver = LiveEstimator(estimator)
                self._estimator = estimator
        except ReconstructionError as error:
            self._problem, self._is_of_settings = str(error), isinstance(error, UnusableSettings)


def _changed(bench: Bench, changes: Sequence[tuple[str, Any]]) -> Bench:
    for name, value in changes:
        section, _, key = name.partition(".")
        if name == "lenslets":
            bench = bench.with_excluded(*value)
        else:
            new = replace(getattr(bench, section), **{key: value}) if key else value
            bench = replace(bench, **{section: new})
    if not fits(bench, Bench):
        raise ValueError("a setting has a wrong type")
    return bench


def _command(request: Callable[Concatenate[Instrument, P], T]) -> Callable[Concatenate[Commands, P], Future[T]]:
    """Return the method that sends a request of the instrument, which executes it between two frames."""

    @wraps(request)
    def send(to: Commands, /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        future: Future[T] = to.commands.submit(request, *arguments, **named)
        return future

    return send


class Commands:
    """The commands. Any thread may send one; its future resolves after the status is updated."""

    commands: Any  # takes them: the queue of the worker, or what the connection sends

    set_running = _command(Instrument.set_running)
    set_exposure_s = _command(Instrument.set_exposure_s)
    set_em_gain = _command(Instrument.set_em_gain)
    set_amplifier = _command(Instrument.set_amplifier)
    set_readout_speed = _command(Instrument.set_readout_speed)
    set_current_a = _command(Instrument.set_current_a)
    set_light_on = _command(Instrument.set_light_on)
    set_sample_in = _command(Instrument.set_sample_in)
    set_area = _command(Instrument.set_area)
    take_dark = _command(Instrument.take_dark)
    take_reference = _command(Instrument.take_reference)
    use = _command(Instrument.use)
    auto_expose = _command(Instrument.auto_expose)
    check_background = _command(Instrument.check_background)
    find_lattice = _command(Instrument.find_lattice)
    survey_lattice = _command(Instrument.survey_lattice)
    measure_linearity = _command(Instrument.measure_linearity)
    change_settings = _command(Instrument.change_settings)
    undoable = _command(Instrument.undoable)
    undo = _command(Instrument.undo)
    start_recording = _command(Instrument.start_recording)
    keep_recent = _command(Instrument.keep_recent)
