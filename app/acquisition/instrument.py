"""The instrument: devices, dark, reference and the reconstructor made of them.

It has no thread of its own; whoever holds it owns the devices. `Status` is the frozen view of it that others may see.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from app.bench.config import Bench, with_known
from app.measurement.calibration import Calibration, surveyed
from app.measurement.live_refinement import LiveRefinement, RefinementState
from app.measurement.measurement import PASSED_OVER
from app.measurement.routines import (
    AutoExposure,
    Average,
    BackgroundCheck,
    Circumstances,
    Progress,
    RoutineError,
    ShouldStop,
    auto_expose,
    check_background,
    take_dark,
    take_reference,
)
from app.measurement.sensor_region import SensorArea, moved, moved_lattice, set_area
from app.timing import Timings
from drivers.interface import BadValue, CameraCapabilities, Devices, Frame, Property, Range, WrongState
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey
from reconstruction.pipeline import Reconstructor
from reconstruction.wavefront import Wavefront

Standing = Literal["missing", "doubtful", "good"]  # of a dark or a reference


@dataclass(frozen=True, slots=True)
class Status:
    """How the instrument stands at one moment, for a window or a report."""

    bench: Bench
    camera_name: str
    light_name: str
    capabilities: CameraCapabilities
    is_running: bool
    area: SensorArea
    exposure_s: float
    amplifier: str
    readout_speed: int
    em_gain: float
    current_range_a: Range
    current_a: float
    is_light_on: bool
    masks: tuple[str, ...]
    mask: str
    is_sample_in: bool
    dark: Standing
    reference: Standing
    lattice: Lattice | None
    warning: str  # why the wavefronts are missing or doubtful; empty when they are not

    @property
    def bench_in_force(self) -> Bench:
        """The bench with what has been set and found since: lattice, exposure, gain, current."""
        camera = {
            "exposure_s": self.exposure_s,
            "amplifier": self.amplifier,
            "readout_speed": self.readout_speed,
            "em_gain": self.em_gain,
        }
        return replace(
            self.bench,
            lattice=self.lattice,
            camera=with_known(self.bench.camera, camera),
            light=with_known(self.bench.light, {"current_a": self.current_a}),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """What became of one frame, and all that is needed to make the same of it again."""

    wavefront: Wavefront | None
    problem: str  # why there is no wavefront; empty when there is one
    calibration: Calibration | None = None
    start: Displacement | None = None  # where the registration began: as the frame before was registered, None if cold
    registered: Displacement | None = None  # what it found; the wavefront's own is less the bias
    refinement: RefinementState = RefinementState()


class Instrument:
    """Devices and what has been measured with them so far."""

    def __init__(self, devices: Devices, bench: Bench, timings: Timings | None = None) -> None:
        self.devices = devices
        self._timings = timings or Timings()
        self._bench = bench
        self._dark: Average | None = None
        self._reference: Average | None = None
        self._dark_taken: Circumstances | None = None
        self._reference_taken: Circumstances | None = None
        self._lattice = bench.lattice
        self._calibration: Calibration | None = None
        self._reconstructor: Reconstructor | None = None
        self._refinement: LiveRefinement | None = None
        self._before: Displacement | None = None  # how the frame before was registered
        self._problem = "no reference yet: take the sample out and take one"

    @property
    def dark(self) -> Average | None:
        """The dark in force."""
        return self._dark

    @property
    def calibration(self) -> Calibration | None:
        """What frames are reconstructed with; None as long as they are not."""
        return self._calibration

    @property
    def reference(self) -> Average | None:
        """The reference in force."""
        return self._reference

    @property
    def bench(self) -> Bench:
        """The bench as it is set now."""
        return self._bench

    def properties(self) -> dict[str, dict[str, Property]]:
        """All that the devices can tell of themselves, for the record."""
        camera, light, stage = self.devices.camera, self.devices.light, self.devices.stage
        return {"camera": camera.properties(), "light": light.properties(), "stage": stage.properties()}

    def status(self) -> Status:
        """Ask the devices how they stand."""
        camera, light, stage = self.devices.camera, self.devices.light, self.devices.stage
        now = Circumstances.of(self.devices)
        problem = self._problem if self._reconstructor is None else ""
        of_dark, of_reference = self._doubt_of_dark(now), self._doubt_of_reference(now)
        return Status(
            bench=self._bench,
            camera_name=camera.name,
            light_name=light.name,
            capabilities=camera.capabilities,
            is_running=camera.is_running,
            area=SensorArea(now.region, now.binning),
            exposure_s=camera.exposure_s,
            amplifier=camera.amplifier,
            readout_speed=camera.readout_speed,
            em_gain=camera.em_gain,
            current_range_a=light.current_range_a,
            current_a=light.current_a,
            is_light_on=light.is_on,
            masks=stage.masks,
            mask=stage.mask,
            is_sample_in=stage.is_sample_in,
            dark=_standing(self._dark, of_dark),
            reference=_standing(self._reference, problem or of_reference),
            lattice=self._lattice,
            warning=problem or of_dark or of_reference,
        )

    def take_dark(self, frames: int, *, progress: Progress, should_stop: ShouldStop) -> None:
        """Take a dark and use it from now on."""
        self._dark = take_dark(self.devices, frames, progress=progress, should_stop=should_stop)
        self._dark_taken = Circumstances.of(self.devices)
        self._prepare()

    def take_reference(self, frames: int, *, progress: Progress, should_stop: ShouldStop) -> None:
        """Take a reference, find the lattice in it if the bench does not say where it is, and use it from now on."""
        self._reference = take_reference(self.devices, frames, progress=progress, should_stop=should_stop)
        self._reference_taken = Circumstances.of(self.devices)
        self._prepare()

    def use(self, calibration: Calibration) -> None:
        """Take over bench, dark and reference that come from elsewhere, as from a recording."""
        self._bench, self._dark, self._reference = calibration.bench, calibration.dark, calibration.reference
        now = Circumstances.of(self.devices)
        self._dark_taken = None if self._dark is None else _as_averaged(now, self._dark)
        self._reference_taken = _as_averaged(now, self._reference)
        self._prepare()

    def auto_expose(self, *, progress: Progress, should_stop: ShouldStop) -> AutoExposure:
        """Find exposure and current for what is in the beam, and use them from now on."""
        sensor, lattice = self._bench.sensor, self._lattice
        pitch_px = sensor.lenslet_pitch_px if lattice is None else lattice.pitch_px
        return auto_expose(self.devices, pitch_px, progress=progress, should_stop=should_stop)

    def check_background(self, frames: int, *, progress: Progress, should_stop: ShouldStop) -> BackgroundCheck:
        """Compare the background of now with the dark; `RoutineError` where there is none that it compares with."""
        doubt = self._doubt_of_dark(Circumstances.of(self.devices))
        if self._dark is None or doubt:
            raise RoutineError(doubt)
        return check_background(self.devices, self._dark, frames, progress=progress, should_stop=should_stop)

    def survey_lattice(self) -> Survey:
        """Find the lenslets in the reference; nothing is changed by it."""
        if self._reference is None:
            raise WrongState("the lattice is found in the reference: take one first")
        now = Circumstances.of(self.devices)
        if not _fits(self._reference_taken, now):
            raise WrongState(self._doubt_of_reference(now))
        dark = self._dark if _fits(self._dark_taken, now) else None
        return surveyed(self._bench, dark, self._reference, self.devices.camera.capabilities.full_scale)

    def read_out(self, area: SensorArea) -> SensorArea:
        """Have the camera, stopped for it, read out another part of its sensor; return what it really took.

        The lattice goes along. Dark and reference are of no use until they are taken again, or the area is as before.
        """
        camera, before = self.devices.camera, SensorArea.of(self.devices.camera)
        whole = camera.capabilities.sensor
        with camera.paused():
            taken = set_area(camera, area)
            try:
                bench = moved(self._bench, before, taken, whole)
                lattice = None if self._lattice is None else moved_lattice(self._lattice, before, taken)
            except BadValue:
                set_area(camera, before)
                raise
        if taken != before:
            self._bench, self._lattice = bench, lattice
            self._prepare()
        return taken

    def change_settings(self, change: Callable[[Bench], Bench]) -> None:
        """Replace the settings of registration and reconstruction by what `change` makes of the bench."""
        try:
            self._bench = change(self._bench)
        except ValueError as error:  # the settings refuse what cannot be
            raise BadValue(str(error)) from error
        self._prepare()

    def measure(self, frame: Frame) -> Reconstruction:
        """Reconstruct a frame, or say why it cannot be done."""
        calibration, start = self._calibration, self._before
        if self._reconstructor is None:
            return Reconstruction(None, self._problem)
        try:
            with self._timings.of("register"):
                registered = self._reconstructor.register(frame.pixels, start=start)
            with self._timings.of("reconstruct"):
                wavefront, refinement = self._solve(self._reconstructor, registered, frame.camera_time_s)
        except ReconstructionError as error:
            return Reconstruction(None, str(error), calibration, start)
        self._before = registered
        return Reconstruction(wavefront, "", calibration, start, registered, refinement)

    def pass_over(self, frame: Frame) -> Reconstruction:
        """Leave a frame for later, with what it takes: the calibration, and what corrected the frame before."""
        refinement = RefinementState() if self._refinement is None else self._refinement.as_before(frame.camera_time_s)
        return Reconstruction(None, PASSED_OVER, self._calibration, refinement=refinement)

    def close(self) -> None:
        """Let go of what works beside the frames; the devices belong to whoever opened them."""
        if self._refinement is not None:
            self._refinement.close()
        self._refinement = None

    def _solve(
        self, reconstructor: Reconstructor, registered: Displacement, time_s: float
    ) -> tuple[Wavefront, RefinementState]:
        if self._refinement is None:
            return reconstructor.solve(registered), RefinementState()
        return self._refinement.refine(registered, time_s)

    def _prepare(self) -> None:
        """Make the reconstructor anew, the camera paused; what stands in the way becomes the warning that all see."""
        self._calibration = self._reconstructor = self._before = None
        self.close()
        if self._reference is None:
            return
        camera, bench, now = self.devices.camera, self._bench, Circumstances.of(self.devices)
        if not _fits(self._reference_taken, now):
            self._problem = self._doubt_of_reference(now)
            return
        dark = self._dark if _fits(self._dark_taken, now) else None
        try:
            with camera.paused():
                calibration = Calibration.of(bench, dark, self._reference, camera.capabilities.full_scale)
                self._lattice = calibration.lattice
                self._reconstructor = calibration.reconstructor()
                self._calibration = calibration
                if bench.reconstruction.refine:
                    self._refinement = LiveRefinement(bench, self._reconstructor)
        except ReconstructionError as error:
            self._problem = str(error)

    def _doubt_of_dark(self, now: Circumstances) -> str:
        """Why the dark does not go with the frames of now; empty when it does."""
        return _doubt("dark", self._dark_taken, now, is_lit=False)

    def _doubt_of_reference(self, now: Circumstances) -> str:
        """Why the reference does not go with the frames of now; empty when it does."""
        return _doubt("reference", self._reference_taken, now, is_lit=True)


def _as_averaged(now: Circumstances, average: Average) -> Circumstances:
    """Return the circumstances of now, but for what is known of an average."""
    return replace(now, exposure_s=average.exposure_s, em_gain=average.em_gain, amplifier=average.amplifier)


def _fits(taken: Circumstances | None, now: Circumstances) -> bool:
    """Whether what was taken then has the pixels of the frames of now."""
    return taken is not None and taken.shows_same_pixels(now)


def _doubt(what: str, taken: Circumstances | None, now: Circumstances, *, is_lit: bool) -> str:
    if taken is None:
        return f"no {what} yet: the background is a guess"
    changed = taken.differs(now, is_lit=is_lit)
    return f"the {what} was taken {changed}: take it again" if changed else ""


def _standing(average: Average | None, doubt: str) -> Standing:
    if average is None:
        return "missing"
    return "doubtful" if doubt else "good"
