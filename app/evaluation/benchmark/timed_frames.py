"""Calls timed in turn, and frames of the simulated bench for them, also tiled to larger ones."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.frames import NoiseFreeFrames, simulating, with_screen
from app.measurement.averages import FRAMES
from app.measurement.calibration import Calibration
from app.progress import Progress
from reconstruction.arrays import Counts, Floats, Image
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.geometry import Lattice
from reconstruction.pipeline import Reconstructor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings

_DRIFT_M = 5e-6  # of the screen between the two frames: 0.03 rad, more than a live frame changes
_BRIGHTEST = 2000.0  # counts of the noisy reference's brightest pixel
_OFFSET, _READ_NOISE = 100.0, 8.0  # counts


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimedFrames:
    """A reference and two consecutive frames of a bench."""

    bench: Bench
    lattice: Lattice
    dark: Image  # counts, (row, column)
    reference: Image  # counts, (row, column)
    before: Counts  # counts of the first frame, (row, column)
    frame: Counts  # counts of the second frame, (row, column)
    truth: Floats | None  # of the second frame, rad, (view_row, view_column, lenslet_row, lenslet_column)
    noise: CameraNoise | None

    def reconstructor(
        self, registration: RegistrationSettings, reconstruction: ReconstructionSettings | None = None
    ) -> Reconstructor:
        """Prepare for the reference; `reconstruction` has its defaults if omitted."""
        reconstruction = reconstruction or ReconstructionSettings()
        bench = replace(self.bench, registration=registration, reconstruction=reconstruction)
        known = KnownNoise(self.noise, FRAMES if self.noise is not None else np.inf)
        given = Calibration.of_images(bench, self.reference, dark=self.dark, lattice=self.lattice)
        return replace(given, known=known).reconstructor()


def noise_free(bench: Bench) -> TimedFrames:
    """Return mean photons of a bench whose screen drifts a little between the two frames."""
    drifting = with_screen(bench, drift_x_m_per_s=_DRIFT_M)
    rendered = NoiseFreeFrames(simulating(drifting, drifting_states=2, state_duration_s=1.0))
    reference, newest = rendered.reference("square"), rendered.frame("square")
    return TimedFrames(
        bench=bench,
        lattice=bench.design_lattice(*reference.shape),
        dark=np.zeros_like(reference),
        reference=reference,
        before=rendered.frame("square", 1).photons,
        frame=newest.photons,
        truth=newest.truth,
        noise=None,
    )


def noisy(frames: TimedFrames, rng: np.random.Generator) -> TimedFrames:
    """Return the frames of a camera with shot noise, read noise and an offset."""
    scale = _BRIGHTEST / frames.reference.max()

    def photograph(light: NDArray[Any]) -> NDArray[np.uint16]:
        electrons = rng.poisson(np.maximum(light * scale, 0)) + rng.normal(_OFFSET, _READ_NOISE, light.shape)
        return np.asarray(np.clip(np.rint(electrons), 0, np.iinfo(np.uint16).max), np.uint16)

    references = [photograph(frames.reference) for _ in range(FRAMES)]
    return replace(
        frames,
        dark=np.full_like(frames.dark, _OFFSET),
        reference=np.mean(references, axis=0, dtype=np.float32),
        before=photograph(frames.before),
        frame=photograph(frames.frame),
        noise=CameraNoise(counts_per_electron=1.0, read_noise_counts=_READ_NOISE),
    )


def tiled(frames: TimedFrames, lenslets: int, *, margin_px: int = 0) -> TimedFrames:
    """Tile frames of `lenslets` x `lenslets` with a dark margin; their truth is unknown.

    `ValueError` if lenslets of whole pixels do not fill the frame.
    """
    sensor, pitch_px = frames.bench.sensor, round(frames.lattice.pitch_px)
    rows, columns = frames.reference.shape
    if (rows, columns) != (sensor.lenslet_rows * pitch_px, sensor.lenslet_columns * pitch_px):
        raise ValueError(f"{rows} x {columns} pixels are not filled by lenslets of {pitch_px} pixels")
    copies = -(-lenslets // sensor.lenslet_rows), -(-lenslets // sensor.lenslet_columns)
    length = lenslets * pitch_px

    def repeated(image: NDArray[Any], margin: float) -> NDArray[Any]:
        return np.pad(np.tile(image, copies)[:length, :length], margin_px, constant_values=margin)

    offset = float(frames.dark.flat[0])
    middle_px = (length + 2 * margin_px - 1) / 2
    return replace(
        frames,
        bench=replace(frames.bench, sensor=replace(sensor, lenslet_rows=lenslets, lenslet_columns=lenslets)),
        lattice=replace(frames.lattice, center_x_px=middle_px, center_y_px=middle_px),
        dark=repeated(frames.dark, offset),
        reference=repeated(frames.reference, offset),
        before=repeated(frames.before, round(offset)),
        frame=repeated(frames.frame, round(offset)),
        truth=None,
    )


_TURN_S = 0.02  # minimum duration of a turn; quicker calls are repeated
_LEAST_CALLS = 3


def side_by_side(
    calls: Mapping[str, Callable[[], Any]], budget_s: float, progress: Progress = lambda *_: None
) -> dict[str, list[float]]:
    """Time calls in turn until each has had `budget_s` and three calls.

    So other load slows all of them alike. Returns the seconds of each call by contestant; its first call may compile or
    load something and is not timed.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for index, (name, call) in enumerate(calls.items()):
        progress(name, index / len(calls) / 2)
        call()
    waiting = dict(calls)
    while waiting:
        for name, call in list(waiting.items()):
            progress(name, 1 - len(waiting) / len(calls) / 2)
            turn_s = 0.0
            while turn_s < _TURN_S:
                start_s = time.perf_counter()
                call()
                seconds[name].append(time.perf_counter() - start_s)
                turn_s += seconds[name][-1]
            if sum(seconds[name]) >= budget_s and len(seconds[name]) >= _LEAST_CALLS:
                del waiting[name]
    return seconds


def medians_s(calls: Mapping[str, Callable[[], Any]], budget_s: float) -> dict[str, float]:
    """Time calls in turn; return the median time, s, of each."""
    return {name: float(np.median(seconds)) for name, seconds in side_by_side(calls, budget_s).items()}
