"""The frames that all are timed on: of the simulated bench, without noise and with it, and tiled to larger ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.noise_free import NoiseFreeFrames
from reconstruction.arrays import Counts, Floats, Image
from reconstruction.frame.noise import CameraNoise
from reconstruction.geometry import Field, Lattice, Sensor
from reconstruction.pipeline import Reconstructor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings

_DRIFT_M = 5e-6  # of the screen between the frame before and the frame: 0.03 rad, of which a live frame changes less
_BRIGHTEST = 2000.0  # counts of the reference's brightest pixel, where there is noise
_OFFSET, _READ_NOISE = 100.0, 8.0  # counts
_REFERENCE_FRAMES = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """A reference, two frames that follow each other, and what is known of them."""

    sensor: Sensor
    lattice: Lattice
    field: Field
    dark: Image  # counts, (row, column)
    reference: Image  # counts, likewise
    before: Counts  # counts of the frame before, likewise
    frame: Counts  # counts, likewise
    truth: Floats | None  # of the frame, rad, (view_row, view_column, lenslet_row, lenslet_column)
    noise: CameraNoise | None

    def reconstructor(
        self, registration: RegistrationSettings, reconstruction: ReconstructionSettings | None = None
    ) -> Reconstructor:
        """Prepare for the reference; without `reconstruction`, as by default."""
        return Reconstructor(
            self.reference,
            sensor=self.sensor,
            lattice=self.lattice,
            field=self.field,
            registration=registration,
            reconstruction=reconstruction or ReconstructionSettings(),
            dark=self.dark,
            noise=self.noise,
            reference_frames=_REFERENCE_FRAMES if self.noise is not None else np.inf,
        )


def noise_free(bench: Bench) -> Case:
    """Mean photons of a bench whose screen drifts a little between the two frames."""
    screen = replace(bench.simulation.screen, drift_x_m_per_s=_DRIFT_M)
    simulation = replace(bench.simulation, screen=screen, drifting_states=2, state_duration_s=1.0)
    rendered = NoiseFreeFrames(replace(bench, simulation=simulation))
    reference, now = rendered.reference("square"), rendered.frame("square", 0)
    lattice = bench.lattice or Lattice(
        center_x_px=(reference.shape[1] - 1) / 2,
        center_y_px=(reference.shape[0] - 1) / 2,
        pitch_px=bench.sensor.lenslet_pitch_px,
    )
    return Case(
        sensor=bench.sensor,
        lattice=lattice,
        field=bench.field,
        dark=np.zeros_like(reference),
        reference=reference,
        before=rendered.frame("square", 1).photons,
        frame=now.photons,
        truth=now.truth,
        noise=None,
    )


def noisy(case: Case, rng: np.random.Generator) -> Case:
    """Return what a camera with shot noise, read noise and an offset makes of a case."""
    scale = _BRIGHTEST / case.reference.max()

    def photograph(light: NDArray[Any]) -> NDArray[np.uint16]:
        electrons = rng.poisson(np.maximum(light * scale, 0)) + rng.normal(_OFFSET, _READ_NOISE, light.shape)
        return np.asarray(np.clip(np.rint(electrons), 0, np.iinfo(np.uint16).max), np.uint16)

    references = [photograph(case.reference) for _ in range(_REFERENCE_FRAMES)]
    return replace(
        case,
        dark=np.full_like(case.dark, _OFFSET),
        reference=np.mean(references, axis=0, dtype=np.float32),
        before=photograph(case.before),
        frame=photograph(case.frame),
        noise=CameraNoise(counts_per_electron=1.0, read_noise_counts=_READ_NOISE),
    )


def tiled(case: Case, lenslets: int, *, margin_px: int = 0) -> Case:
    """Return a case of `lenslets` x `lenslets`, made of copies of another side by side, with an empty margin.

    Its lattice must fill the frame with whole pixels to a lenslet: no truth is known of the wavefront then.
    """
    rows, columns = case.reference.shape
    pitch_px = round(case.lattice.pitch_px)
    copies = -(-lenslets // case.sensor.lenslet_rows), -(-lenslets // case.sensor.lenslet_columns)
    length = lenslets * pitch_px
    if (rows, columns) != (case.sensor.lenslet_rows * pitch_px, case.sensor.lenslet_columns * pitch_px):
        raise ValueError(f"{rows} x {columns} pixels are not filled by lenslets of {pitch_px} pixels")

    def many(image: NDArray[Any], margin: float) -> NDArray[Any]:
        return np.pad(np.tile(image, copies)[:length, :length], margin_px, constant_values=margin)

    offset = float(case.dark.flat[0])
    middle_px = (length + 2 * margin_px - 1) / 2
    return replace(
        case,
        sensor=replace(case.sensor, lenslet_rows=lenslets, lenslet_columns=lenslets),
        lattice=replace(case.lattice, center_x_px=middle_px, center_y_px=middle_px),
        dark=many(case.dark, offset),
        reference=many(case.reference, offset),
        before=many(case.before, round(offset)),
        frame=many(case.frame, round(offset)),
        truth=None,
    )
