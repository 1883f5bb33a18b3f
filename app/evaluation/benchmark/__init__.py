"""Speed of svwfs on frames of the simulated bench: registration, solve, layers, forward model, growing lattices."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.frames import NoiseFreeFrames, simulating, with_screen
from app.measurement.averages import FRAMES
from app.measurement.calibration import Calibration
from app.progress import Progress, between, named
from app.run_facts import machine_facts, versions
from reconstruction.arrays import Counts, Floats, Image
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.geometry import Lattice, centered_steps
from reconstruction.reconstructor import Reconstructor
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import FIELD_MODES, ReconstructionSettings, RegistrationSettings, Warp
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Wavefront
from simulated_devices.optics.forward_model import ForwardModel, phase_only
from simulated_devices.optics.source import SourcePoints

Json = dict[str, Any]

_SIZES = (5, 10, 15, 30, 64, 100)  # lenslets along a side
_LARGE_LENSLETS, _LARGE_MARGIN_PX = 64, 32  # 31 pixels each on 2048 x 2048


def run_benchmark(
    bench: Bench, progress: Progress, *, budget_s: float = 1.5, sizes: Sequence[int] = _SIZES, with_four_k: bool = True
) -> Json:
    """Time everything with BLAS in one thread, as in the live path, each call for `budget_s`."""
    with one_blas_thread():
        progress("rendering", 0.0)
        frames = noisy(noise_free(bench), np.random.default_rng(1))
        step = named(between(progress, 0.05, 0.4), "timing")
        result: Json = {"times": times_of(dict(ours(frames)), budget_s, step)}
        progress("frames in a loop", 0.45)
        result["frames_per_s"] = _frames_per_s(frames, budget_s)
        progress("one layer", 0.5)
        result["layer"] = _layer_times(frames, budget_s / 2)
        progress("forward model", 0.55)
        seconds = medians_s({"image": square_of_points(frames)}, budget_s)["image"]
        result["forward"] = {"s_per_point": seconds / POINTS**2}
        step = named(between(progress, 0.6, 0.9), "timing")
        result["growth"] = _growth(frames, sizes, budget_s / 3, step)
        if with_four_k:
            progress("64 x 64 lenslets on 2048 x 2048 pixels", 0.9)
            large = tiled(frames, _LARGE_LENSLETS, margin_px=_LARGE_MARGIN_PX)
            result["four_k"] = _timed(large, "quadratic", budget_s / 3)
        return result | {"machine": machine_facts(), "versions": versions()}


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
        bench = replace(
            self.bench, registration=registration, reconstruction=reconstruction or ReconstructionSettings()
        )
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


def times_of(
    calls: Mapping[str, Callable[[], Any]], budget_s: float, progress: Progress
) -> dict[str, dict[str, float]]:
    """Time calls in turn; return median and shortest time, s, and the number of calls of each."""
    seconds = side_by_side(calls, budget_s, progress)
    return {
        name: {"median_s": float(np.median(each)), "best_s": min(each), "calls": len(each)}
        for name, each in seconds.items()
    }


WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic")
THREADS = (1, 2)


def _name_of(warp: Warp, *, is_warm: bool, threads: int) -> str:
    return f"{warp}, {'warm' if is_warm else 'cold'}, {threads} thread{'s' * (threads > 1)}"


def ours(frames: TimedFrames) -> Iterator[tuple[str, Callable[[], Wavefront]]]:
    """Yield name and call of every warp, cold and started at the previous frame, in one and two threads."""
    for warp, threads in product(WARPS, THREADS):
        reconstructor = frames.reconstructor(RegistrationSettings(warp=warp, threads=threads))
        before = reconstructor.register(frames.before)
        for is_warm in (False, True):
            start = before if is_warm else None
            yield (
                _name_of(warp, is_warm=is_warm, threads=threads),
                lambda reconstructor=reconstructor, start=start: reconstructor.solve(  # type: ignore[misc] # bound now
                    reconstructor.register(frames.frame, start=start)
                ),
            )


def _frames_per_s(frames: TimedFrames, seconds: float) -> float:
    """Return the rate of a loop of warm frames, 1/s."""
    reconstructor = frames.reconstructor(RegistrationSettings(warp="quadratic"))
    displacement = reconstructor.register(frames.before)
    count, start_s = 0, time.perf_counter()
    while time.perf_counter() < start_s + seconds:
        for frame in (frames.frame, frames.before):
            displacement = reconstructor.register(frame, start=displacement)
            reconstructor.solve(displacement)
            count += 1
    return count / (time.perf_counter() - start_s)


_RATIO = -0.975  # of field to pupil position: 195 mm in front of the lenslets of the paper's bench


def _layer_times(frames: TimedFrames, budget_s: float) -> dict[str, float]:
    """Return seconds from displacements to a layer at a known distance, and to layers at unknown ones."""
    reconstructor = frames.reconstructor(RegistrationSettings())
    displacement = reconstructor.register(frames.frame)
    calls: dict[str, Callable[[], Any]] = {
        "known_s": lambda: reconstructor.layers(displacement).fit(_RATIO),
        "search_s": partial(reconstructor.find_sample, displacement),
    }
    return medians_s(calls, budget_s)


POINTS = 8  # along a side
BEND_RAD_PER_M2 = 3e5


def square_of_points(frames: TimedFrames) -> Callable[[], NDArray[Any]]:
    """Prepare the image (row, column) of a square of object points, m^2."""
    bench, (rows, columns) = frames.bench, frames.reference.shape
    model = ForwardModel(
        bench.sensor,
        frames.lattice,
        bench.field,
        shape=(rows, columns),
        pupil_samples=bench.simulation.pupil_samples,
        pixel_fill_factor=1.0,
        border_lenslets=0,
    )
    x_m, y_m = model.sample_x_m[None, :], model.sample_y_m[:, None]
    bend = (BEND_RAD_PER_M2 * (x_m**2 + y_m**2)).astype(np.float32)
    along_m = centered_steps(POINTS) / POINTS * 2 * bench.field.half_width_m
    position_m = np.stack(np.meshgrid(along_m, along_m), axis=-1).reshape(-1, 2)
    source = SourcePoints(position_m=position_m, area_m2=np.ones(len(position_m)))
    return lambda: model.irradiance(source, phase_only(lambda _x, _y: bend))


def _growth(frames: TimedFrames, sizes: Sequence[int], budget_s: float, progress: Progress) -> list[dict[str, float]]:
    """Time quadratic warps on lattices of several sizes, affine and cubic ones on their own."""
    own = frames.bench.sensor.lenslet_rows
    cases: list[tuple[int, Warp]] = []
    for size in dict.fromkeys((*sizes, own)):
        cases += [(size, "quadratic")] * (size in sizes)
        cases += [(size, "affine"), (size, "cubic")] if size == own else []
    found = []
    for index, (size, warp) in enumerate(cases):
        progress(f"{size} x {size} lenslets, {warp}", index / len(cases))
        found.append(_timed(tiled(frames, size), warp, budget_s))
    return found


def _timed(frames: TimedFrames, warp: Warp, budget_s: float) -> dict[str, float]:
    lenslets = frames.bench.sensor.lenslet_rows
    start_s = time.perf_counter()
    reconstructor = frames.reconstructor(RegistrationSettings(warp=warp))
    before = reconstructor.register(frames.before)
    reconstructor.solve(before)  # computes the factors of the lenslets' weights once
    prepare_s = time.perf_counter() - start_s
    displacement = reconstructor.register(frames.frame, start=before)
    sensor = frames.bench.sensor
    zonal = ZonalSolution(
        slopes=displacement.coefficients * sensor.slope_per_px,
        valid=displacement.valid,
        pitch_m=sensor.lenslet_pitch_m,
        arrangement=sensor.arrangement,
        weights=reconstructor.weights_of(displacement),
    )
    times_s = medians_s(
        {
            "register_s": partial(reconstructor.register, frames.frame, start=before),  # warm
            "zonal_s": partial(Wavefront.of, sensor, frames.bench.field, displacement, zonal),
            "modal_s": partial(reconstructor.solve, displacement),  # modes chosen from the lattice
            # counts to all views and coefficients: register and modal
            "frame_s": lambda: reconstructor.solve(reconstructor.register(frames.frame, start=before)),
        },
        budget_s,
    )
    found = {
        "lenslets": lenslets,  # along a side
        "field_modes": FIELD_MODES[warp],
        "frame_px": frames.reference.shape[0],  # along a side
        "prepare_s": prepare_s,  # from a new reference to the first wavefronts
        **times_s,
        "per_lenslet_us": times_s["frame_s"] / lenslets**2 * 1e6,
    }
    if sys.platform != "win32":  # which does not tell
        import resource  # noqa: PLC0415 - not there on Windows

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # of this process so far
        found["peak_memory_mb"] = peak / 2**20 if sys.platform == "darwin" else peak / 2**10
    return found
