"""Speed of the reconstruction on frames of the simulated bench: one frame, search for layers, growing lattices."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.frames import NoiseFreeFrames, simulating, with_screen
from app.measurement.averages import FRAMES
from app.measurement.calibration import Calibration
from app.progress import Progress
from app.run_facts import machine_facts, versions
from reconstruction.arrays import Counts, Floats, Image
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.geometry import Lattice
from reconstruction.reconstructor import Reconstructor
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import ReconstructionSettings, RegistrationSettings

Json = dict[str, Any]

_SIZES = ((5, 0), (10, 0), (30, 0), (64, 0), (100, 0), (64, 32))  # lenslets along a side, margin, px; 2048 px at last
_LEAST_CALLS = 3


def run_benchmark(
    bench: Bench, progress: Progress, *, budget_s: float = 1.5, sizes: Sequence[tuple[int, int]] = _SIZES
) -> Json:
    """Time the quadratic warp for `budget_s` a call, with one BLAS thread as live; the bench's lattice comes first."""
    with one_blas_thread():
        progress("rendering", 0.0)
        frames = noisy(noise_free(bench), np.random.default_rng(1))
        lattices = [_timed(frames, budget_s)]
        for done, (lenslets, margin_px) in enumerate(sizes, 1):
            progress(f"{lenslets} x {lenslets} lenslets", done / (len(sizes) + 2))
            lattices.append(_timed(tiled(frames, lenslets, margin_px=margin_px), budget_s))
        progress("search for layers", 1 - 1 / (len(sizes) + 2))
        reconstructor = frames.reconstructor(RegistrationSettings())
        displacement = reconstructor.register(frames.frame)
        search_s = median_s(lambda: reconstructor.find_sample(displacement), budget_s)
    facts = {"machine": machine_facts(), "versions": versions()}
    return {"lattices": lattices, "layer_search_s": search_s} | facts


def _timed(frames: TimedFrames, budget_s: float) -> Json:
    """Times, s, of a lattice; `solve_s` is the time of all views and coefficients from the displacements."""
    lenslets = frames.bench.sensor.lenslets[0]
    start_s = time.perf_counter()
    reconstructor = frames.reconstructor(RegistrationSettings(warp="quadratic"))
    before = reconstructor.register(frames.before)
    reconstructor.solve(before)  # computes the factors of the lenslets' weights once
    prepare_s = time.perf_counter() - start_s
    displacement = reconstructor.register(frames.frame, start=before)
    register_s = median_s(lambda: reconstructor.register(frames.frame, start=before), budget_s)
    solve_s = median_s(lambda: reconstructor.solve(displacement), budget_s)
    frame_s = median_s(lambda: reconstructor.solve(reconstructor.register(frames.frame, start=before)), budget_s)
    return {
        "lenslets": lenslets,  # along a side
        "frame_px": frames.reference.shape[0],  # along a side
        "prepare_s": prepare_s,  # from a new reference to the first wavefronts
        "register_s": register_s,
        "solve_s": solve_s,
        "frame_s": frame_s,
        "frames_per_s": 1 / frame_s,
        "per_lenslet_us": frame_s / lenslets**2 * 1e6,
    }


def median_s(call: Callable[[], Any], budget_s: float) -> float:
    """Return the median time, s, of calls for `budget_s`, at least three; the first one is not timed."""
    call()
    seconds: list[float] = []
    while sum(seconds) < budget_s or len(seconds) < _LEAST_CALLS:
        start_s = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start_s)
    return float(np.median(seconds))


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
        settings = reconstruction or ReconstructionSettings()
        bench = replace(self.bench, registration=registration, reconstruction=settings)
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
    """Tile frames with a dark margin to `lenslets` a side; `ValueError` if lenslets of whole pixels do not fit them."""
    sensor, pitch_px = frames.bench.sensor, round(frames.lattice.pitch_px)
    rows, columns = frames.reference.shape
    if (rows, columns) != tuple(count * pitch_px for count in sensor.lenslets):
        raise ValueError(f"{rows} x {columns} pixels are not filled by lenslets of {pitch_px} pixels")
    copies = tuple(-(-lenslets // count) for count in sensor.lenslets)
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
