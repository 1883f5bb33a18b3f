"""Frames for timing: noise-free or noisy frames of the simulated bench, and larger ones tiled from them."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.noise_free import NoiseFreeFrames
from app.measurement.calibration import Calibration, KnownNoise
from reconstruction.arrays import Counts, Floats, Image
from reconstruction.frame.noise import CameraNoise
from reconstruction.geometry import Field, Lattice, Sensor
from reconstruction.pipeline import Reconstructor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings

_DRIFT_M = 5e-6  # of the screen between the two frames: 0.03 rad, more than a live frame changes
_BRIGHTEST = 2000.0  # counts of the noisy reference's brightest pixel
_OFFSET, _READ_NOISE = 100.0, 8.0  # counts
_REFERENCE_FRAMES = 20  # as start_up.FRAMES, whose import would add to the measured memory


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

    @property
    def sensor(self) -> Sensor:
        """The bench's sensor."""
        return self.bench.sensor

    @property
    def field(self) -> Field:
        """The bench's field."""
        return self.bench.field

    def reconstructor(
        self, registration: RegistrationSettings, reconstruction: ReconstructionSettings | None = None
    ) -> Reconstructor:
        """Prepare for the reference; `reconstruction` has its defaults if omitted."""
        reconstruction = reconstruction or ReconstructionSettings()
        bench = replace(self.bench, registration=registration, reconstruction=reconstruction)
        known = KnownNoise(self.noise, _REFERENCE_FRAMES if self.noise is not None else np.inf)
        given = Calibration.of_images(bench, self.reference, dark=self.dark, lattice=self.lattice, known=known)
        return given.reconstructor()


def noise_free(bench: Bench) -> TimedFrames:
    """Return mean photons of a bench whose screen drifts a little between the two frames."""
    screen = replace(bench.simulation.screen, drift_x_m_per_s=_DRIFT_M)
    simulation = replace(bench.simulation, screen=screen, drifting_states=2, state_duration_s=1.0)
    rendered = NoiseFreeFrames(replace(bench, simulation=simulation))
    reference, newest = rendered.reference("square"), rendered.frame("square", 0)
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

    references = [photograph(frames.reference) for _ in range(_REFERENCE_FRAMES)]
    return replace(
        frames,
        dark=np.full_like(frames.dark, _OFFSET),
        reference=np.mean(references, axis=0, dtype=np.float32),
        before=photograph(frames.before),
        frame=photograph(frames.frame),
        noise=CameraNoise(counts_per_electron=1.0, read_noise_counts=_READ_NOISE),
    )


def tiled(frames: TimedFrames, lenslets: int, *, margin_px: int = 0) -> TimedFrames:
    """Return frames of `lenslets` x `lenslets`, made of copies side by side, with a dark margin and without a truth.

    Raises
    ------
    ValueError
        If lenslets of whole pixels do not fill the frame.
    """
    sensor, pitch_px = frames.sensor, round(frames.lattice.pitch_px)
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
