"""Start of a bench: the commands that calibrate it, also step by step with a person, and runs without a user."""

import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.acquisition.instrument import Status
from app.acquisition.remote.connection import RunningInstrument
from app.bench.config import Bench
from app.errors import InputError, RunError
from app.measurement.auto_exposure import FILL
from app.measurement.averages import FRAMES
from app.measurement.routines import Cancelled
from app.progress import Progress
from app.timing import StageTimes, TimedStage
from reconstruction.geometry import Lattice

_HOPELESS_FRAMES = 20  # without a wavefront, when the bench is calibrated
_SAME_LATTICE = 0.05  # of the pitch; frames are doubted beyond


def start_up(acquisition: RunningInstrument, frames: int = FRAMES, *, is_lit: bool = True) -> tuple[Future[Any], ...]:
    """Turn the light on, take a dark and a reference, move the sample in and start the camera.

    The steps run in order; cancelling one skips only that one. With a manual stage the position of the sample is
    unknown: the camera starts after the dark, and the user requests the reference. Unless `is_lit`, the light stays
    off, and there is no reference.
    """
    has_motor, steps = not acquisition.bench.has_manual_stage, list[Future[Any]]()
    if is_lit:
        steps.append(acquisition.set_light_on(True))
    steps.append(acquisition.take_dark(frames))
    if is_lit and has_motor:
        steps.append(acquisition.take_reference(frames))
    if has_motor:
        steps.append(acquisition.set_sample_in(True))
    return (*steps, acquisition.set_running(True))


def knows_sample(acquisition: RunningInstrument) -> bool:
    """True if sample and correction of the newest frame are known, after some seconds; false with few frames."""
    newest = acquisition.newest
    if newest is None or not newest.counts.acquired:
        return False
    return newest.assumed.sample is not None and newest.assumed.refinement.stage != "preparing"


def is_recorded(acquisition: RunningInstrument) -> bool:
    """True if the recording is over, or there is none."""
    return acquisition.recording is None or acquisition.recording.is_over


@dataclass(frozen=True, slots=True)
class CalibrationStep:
    """One routine of the guided calibration; it restores the devices, also when it is cancelled."""

    title: str
    explanation: str
    is_lit: bool  # whether its frames need the light
    begin: Callable[[RunningInstrument, int], Future[Any]]  # sends it, with the number of averaged frames


LATTICE = CalibrationStep(
    "Lattice",
    "Finds the lenslets in a few frames without the sample",
    is_lit=True,
    begin=lambda to, _: to.find_lattice(),
)
EXPOSURE = CalibrationStep(
    "Exposure",
    "Sets the exposure, and if needed the light's current, so that the brightest lenslets fill"
    f" {100 * FILL:.0f} % of the range",
    is_lit=True,
    begin=lambda to, _: to.auto_expose(without_sample=True),
)
DARK = CalibrationStep(
    "Dark",
    "Averages frames with the light off: the background of all frames",
    is_lit=False,
    begin=lambda to, frames: to.take_dark(frames),
)
REFERENCE = CalibrationStep(
    "Reference",
    "Averages frames with the light on and without the sample: the zero point of the displacements",
    is_lit=True,
    begin=lambda to, frames: to.take_reference(frames),
)
STEPS = (LATTICE, EXPOSURE, DARK, REFERENCE)


def by_hand(step: CalibrationStep, status: Status) -> tuple[str, Callable[[RunningInstrument], Future[None]]] | None:
    """Return what a person must do before a step, if anything, and the command that notes it."""
    if status.bench.has_manual_light and status.is_light_on != step.is_lit:
        return f"switch the light {'on' if step.is_lit else 'off'} by hand", lambda to: to.set_light_on(step.is_lit)
    if status.bench.has_manual_stage and step.is_lit and status.is_sample_in:
        return "take the sample out of the beam", lambda to: to.set_sample_in(False)
    return None


def without_sample(bench: Bench) -> str:
    """Return what a person must do before light without the sample is measured; empty if motors do it."""
    if not bench.has_manual_stage:
        return ""
    return f"take the sample out of the beam, put the mask {bench.simulation.source.mask} in"


def has_moved(found: Lattice, status: Status) -> bool:
    """True if a lattice differs from the bench's by more than 5 % of the pitch anywhere."""
    sensor, before = status.bench.sensor, status.bench.lattice
    if before is None:
        return False  # the reference will show it
    moved_px = found.lenslet_centers_px(*sensor.lenslets) - before.lenslet_centers_px(*sensor.lenslets)
    return bool(np.linalg.norm(moved_px, axis=-1).max() > _SAME_LATTICE * before.pitch_px)


class HeadlessRun:
    """Steps of one instrument; `RunError` or `InputError` if one cannot continue. Each reports its `progress`."""

    def __init__(self, acquisition: RunningInstrument, progress: Progress = lambda *_: None) -> None:
        self.acquisition, self._progress = acquisition, progress
        self._expected: tuple[Future[Any], ...] = ()  # commands that must succeed

    def send(
        self, commands: Callable[[RunningInstrument], tuple[Future[Any], ...]] = start_up
    ) -> tuple[Future[Any], ...]:
        """Send commands that must succeed, such as those that calibrate the bench and turn to the sample."""
        sent = commands(self.acquisition)
        self._expected += sent
        return sent

    def first_wavefront(self, within_s: float) -> Generator[None, None, float]:
        """Wait for the first wavefront after all commands; return when it came (perf_counter), or raise `RunError`."""
        acquisition, seen, failed, problem = self.acquisition, None, 0, ""
        end_s = time.perf_counter() + within_s
        while True:
            self._check()
            newest = acquisition.newest
            if newest is not None and newest is not seen and all(step.done() for step in self._expected):
                if newest.wavefront is not None:
                    return time.perf_counter()
                if not newest.is_skipped:
                    failed, problem = failed + 1, newest.problem
            seen = newest
            if failed >= _HOPELESS_FRAMES:
                raise RunError(f"no wavefront in the first {failed} frames: {problem}")
            if time.perf_counter() > end_s:
                raise RunError(f"no wavefront within {within_s:g} s: {problem or 'no frame came'}")
            self._progress(acquisition.activity.text or "waiting for the first wavefront", 0.0)
            yield

    def until(
        self, is_over: Callable[[], bool], *, text: str = "", fraction: Callable[[], float] = lambda: 0.0
    ) -> Iterator[None]:
        """Wait, a `fraction` of it done, until it is over."""
        while not is_over():
            self._check()
            self._progress(text, fraction())
            yield

    def stage_times(self) -> dict[TimedStage, StageTimes]:
        """Return the times of the instrument's stages, and of those of this process."""
        there, here = self.acquisition.stage_times().result(), self.acquisition.timings.summary()
        return there | {stage: times for stage, times in here.items() if times.count}

    def _check(self) -> None:
        errors = (self.acquisition.error, *(step.exception() for step in self._expected if step.done()))
        # A command is cancelled by someone who continues, or closes.
        error = next((each for each in errors if each is not None and not isinstance(each, Cancelled)), None)
        if error is None:
            return
        if isinstance(error, InputError | RunError):
            raise error
        raise RunError(self.acquisition.failure or str(error) or type(error).__name__) from error
