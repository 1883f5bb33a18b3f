"""The instrument: devices, dark, reference and the reconstructor made of them.

It runs in the thread that owns the devices; other threads see its frozen `Status`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from app.acquisition.validity import Validity, about, as_averaged, doubt, fits, note, validity
from app.bench.config import Bench, with_known
from app.measurement.calibration import Calibration, surveyed
from app.measurement.live_refinement import LiveRefinement, RefinementState
from app.measurement.measurement import SKIPPED
from app.measurement.routines.auto_exposure import AutoExposure, auto_expose
from app.measurement.routines.averages import Average, take_dark, take_reference
from app.measurement.routines.background import BackgroundCheck, check_background
from app.measurement.routines.device_state import Circumstances
from app.measurement.routines.frames import FrameProgress, RoutineError, ShouldStop
from app.measurement.sensor_region import SensorArea, moved_bench, moved_lattice, set_area
from app.timing import Timings
from drivers.interface import BadValue, CameraCapabilities, Devices, Frame, Property, Range, WrongState
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey
from reconstruction.pipeline import Reconstructor
from reconstruction.quality.frame_quality import FrameJudge
from reconstruction.quality.sequence import sequence_quality
from reconstruction.quality.verdict import Quality
from reconstruction.wavefront import Wavefront


@dataclass(frozen=True, slots=True)
class Status:
    """Snapshot of the instrument."""

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
    dark: Validity
    reference: Validity
    dark_note: str  # how it was taken, and why it is doubtful
    reference_note: str
    lattice: Lattice | None
    warning: str  # why wavefronts are missing or doubtful; empty if they are good
    temperature_c: float | None = field(default=None, compare=False)  # of the camera's sensor; None if unknown

    @property
    def bench_in_force(self) -> Bench:
        """The bench with the current lattice, exposure, gain and light current."""
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
    """Result for one frame, and everything needed to reproduce it."""

    wavefront: Wavefront | None
    problem: str  # why there is no wavefront; empty if there is one
    calibration: Calibration | None = None
    start: Displacement | None = None  # initial guess of the registration: the previous frame's displacement
    registered: Displacement | None = None  # as registered; the wavefront's displacement has the bias subtracted
    refinement: RefinementState = RefinementState()
    quality: Quality = Quality()


class Instrument:
    """Devices with their dark, reference and reconstructor."""

    def __init__(self, devices: Devices, bench: Bench, timings: Timings | None = None) -> None:
        self.devices = devices
        self._timings = timings or Timings()
        self.bench = bench  # with the current settings
        self.dark: Average | None = None
        self.reference: Average | None = None
        self.calibration: Calibration | None = None  # None if frames cannot be reconstructed
        self._dark_taken: Circumstances | None = None
        self._reference_taken: Circumstances | None = None
        self._dark_about = self._reference_about = "none yet"
        self._lattice = bench.lattice
        self._reconstructor: Reconstructor | None = None
        self._refinement: LiveRefinement | None = None
        self._judge: FrameJudge | None = None
        self._before: Displacement | None = None  # displacement of the previous frame
        self._previous: Frame | None = None
        self._problem = "no reference yet: take the sample out and take one"

    def properties(self) -> dict[str, dict[str, Property]]:
        """All properties of the devices, for a recording."""
        camera, light, stage = self.devices.camera, self.devices.light, self.devices.stage
        return {"camera": camera.properties(), "light": light.properties(), "stage": stage.properties()}

    def status(self) -> Status:
        """Query the devices."""
        camera, light, stage = self.devices.camera, self.devices.light, self.devices.stage
        now = Circumstances.of(self.devices)
        problem = self._problem if self._reconstructor is None else ""
        of_dark, of_reference = self._doubt_of_dark(now), self._doubt_of_reference(now)
        of_images = "" if self._judge is None else self._judge.of_reference.sentence
        return Status(
            bench=self.bench,
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
            dark=validity(self.dark, of_dark),
            reference=validity(self.reference, problem or of_reference),
            dark_note=note(self._dark_about, of_dark),
            reference_note=note(self._reference_about, problem or of_reference),
            lattice=self._lattice,
            warning=problem or of_dark or of_reference or of_images,
            temperature_c=camera.temperature_c,
        )

    def take_dark(self, frames: int, *, progress: FrameProgress, should_stop: ShouldStop) -> None:
        """Average frames with the light off, and use them as dark from now on."""
        self.dark = take_dark(self.devices, frames, progress=progress, should_stop=should_stop)
        self._dark_taken = Circumstances.of(self.devices)
        self._dark_about = about(self.dark, self._dark_taken)
        self._prepare()

    def take_reference(self, frames: int, *, progress: FrameProgress, should_stop: ShouldStop) -> None:
        """Average frames without the sample, use them as reference from now on, and find the lattice if unknown."""
        self.reference = take_reference(self.devices, frames, progress=progress, should_stop=should_stop)
        self._reference_taken = Circumstances.of(self.devices)
        self._reference_about = about(self.reference, self._reference_taken)
        self._prepare()

    def use(self, calibration: Calibration) -> None:
        """Replace bench, dark and reference, for example by recorded ones."""
        self.bench, self.dark, self.reference = calibration.bench, calibration.dark, calibration.reference
        now = Circumstances.of(self.devices)
        self._dark_taken = None if self.dark is None else as_averaged(now, self.dark)
        self._reference_taken = as_averaged(now, self.reference)
        self._dark_about = self._reference_about = "as recorded"
        self._prepare()

    def auto_expose(self, *, progress: FrameProgress, should_stop: ShouldStop) -> AutoExposure:
        """Find and set exposure and current for what is in the beam."""
        sensor, lattice = self.bench.sensor, self._lattice
        pitch_px = sensor.lenslet_pitch_px if lattice is None else lattice.pitch_px
        return auto_expose(self.devices, pitch_px, progress=progress, should_stop=should_stop)

    def check_background(self, frames: int, *, progress: FrameProgress, should_stop: ShouldStop) -> BackgroundCheck:
        """Compare the current background with the dark; `RoutineError` if there is no dark that fits."""
        doubt = self._doubt_of_dark(Circumstances.of(self.devices))
        if self.dark is None or doubt:
            raise RoutineError(doubt)
        return check_background(self.devices, self.dark, frames, progress=progress, should_stop=should_stop)

    def survey_lattice(self) -> Survey:
        """Find the lenslets in the reference without changing anything."""
        if self.reference is None:
            raise WrongState("the lattice is found in the reference: take one first")
        now = Circumstances.of(self.devices)
        if not fits(self._reference_taken, now):
            raise WrongState(self._doubt_of_reference(now))
        dark = self.dark if fits(self._dark_taken, now) else None
        return surveyed(self.bench, dark, self.reference, self.devices.camera.capabilities.full_scale)

    def set_area(self, area: SensorArea) -> SensorArea:
        """Read out another area of the sensor, the camera paused; return the area that the camera accepted.

        The lattice moves with it. Dark and reference become unusable until they are retaken or the area is restored.
        """
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
            self.bench, self._lattice = bench, lattice
            self._prepare()
        return taken

    def change_settings(self, change: Callable[[Bench], Bench]) -> None:
        """Replace the bench by `change(bench)`; only registration and reconstruction may differ."""
        try:
            self.bench = change(self.bench)
        except ValueError as error:  # inconsistent settings
            raise BadValue(str(error)) from error
        self._prepare()

    def measure(self, frame: Frame) -> Reconstruction:
        """Reconstruct a frame, or say why that is impossible."""
        calibration, start = self.calibration, self._before
        previous, self._previous = self._previous, frame
        if self._reconstructor is None or self._judge is None:
            return Reconstruction(None, self._problem)
        try:
            with self._timings.of("register"):
                registered = self._reconstructor.register(frame.pixels, start=start)
            with self._timings.of("reconstruct"):
                wavefront, refinement = self._solve(self._reconstructor, registered, frame.camera_time_s)
                quality = self._judge(frame.pixels, wavefront.displacement) | _beside(previous, frame)
        except ReconstructionError as error:
            return Reconstruction(None, str(error), calibration, start)
        self._before = registered
        return Reconstruction(wavefront, "", calibration, start, registered, refinement, quality)

    def skip(self, frame: Frame) -> Reconstruction:
        """Skip a frame, keeping what a later reconstruction needs: calibration and the previous frame's correction."""
        self._previous = frame
        refinement = RefinementState() if self._refinement is None else self._refinement.as_before(frame.camera_time_s)
        return Reconstruction(None, SKIPPED, self.calibration, refinement=refinement)

    def close(self) -> None:
        """Stop the refinement thread; the caller closes the devices."""
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
        """Rebuild the reconstructor, the camera paused; a failure becomes the warning in the status."""
        self.calibration = self._reconstructor = self._judge = self._before = None
        self.close()
        if self.reference is None:
            return
        camera, bench, now = self.devices.camera, self.bench, Circumstances.of(self.devices)
        if not fits(self._reference_taken, now):
            self._problem = self._doubt_of_reference(now)
            return
        dark = self.dark if fits(self._dark_taken, now) else None
        try:
            with camera.paused():
                calibration = Calibration.of(bench, dark, self.reference, camera.capabilities.full_scale)
                self._lattice = calibration.lattice
                self._reconstructor = calibration.reconstructor()
                self._judge = calibration.judge(self._reconstructor)
                self.calibration = calibration
                if bench.reconstruction.refine:
                    self._refinement = LiveRefinement(bench, self._reconstructor)
        except ReconstructionError as error:
            self._problem = str(error)

    def _doubt_of_dark(self, now: Circumstances) -> str:
        """Why the dark does not fit the current frames; empty if it does."""
        return doubt("dark", self._dark_taken, now, is_lit=False)

    def _doubt_of_reference(self, now: Circumstances) -> str:
        """Why the reference does not fit the current frames; empty if it does."""
        return doubt("reference", self._reference_taken, now, is_lit=True)


def _beside(previous: Frame | None, frame: Frame) -> Quality:
    """Quality of a frame beside the one before; the camera counts from 0 after a restart."""
    if previous is None or frame.index <= previous.index:
        return Quality()
    return sequence_quality(previous.pixels, frame.pixels, frame.camera_time_s - previous.camera_time_s)
