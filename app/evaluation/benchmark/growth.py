"""Times of frames against the number of lenslets and of field modes, and of a 4-megapixel camera."""

import math
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial

from app.evaluation.benchmark.stopwatch import medians_s, side_by_side
from app.evaluation.benchmark.timed_frames import TimedFrames, tiled
from app.evaluation.cases import CaseResult
from app.progress import Progress
from reconstruction.settings import FIELD_MODES, RegistrationSettings, Warp
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Wavefront

DIMS = ("lenslets", "field_modes")  # lenslets along a side
_LARGE_LENSLETS, _LARGE_MARGIN_PX = 64, 32  # 31 pixels each on 2048 x 2048


def growth(frames: TimedFrames, sizes: Sequence[int], budget_s: float, progress: Progress) -> Iterator[CaseResult]:
    """Time quadratic warps on lattices of several sizes, affine and cubic ones on the frames' own lattice."""
    own = frames.sensor.lenslet_rows
    cases: list[tuple[int, Warp]] = [*((size, "quadratic") for size in sizes), (own, "affine"), (own, "cubic")]
    for index, (size, warp) in enumerate(cases):
        progress(f"{size} x {size} lenslets, {warp}", index / len(cases))
        yield _timed(tiled(frames, size), warp, budget_s)


def large_camera(frames: TimedFrames, budget_s: float) -> CaseResult:
    """Time a 2048 x 2048 camera behind 64 x 64 lenslets of 31 pixels."""
    return _timed(tiled(frames, _LARGE_LENSLETS, margin_px=_LARGE_MARGIN_PX), "quadratic", budget_s)


def _timed(frames: TimedFrames, warp: Warp, budget_s: float) -> CaseResult:
    lenslets = frames.sensor.lenslet_rows
    start_s = time.perf_counter()
    reconstructor = frames.reconstructor(RegistrationSettings(warp=warp))
    before = reconstructor.register(frames.before)
    reconstructor.solve(before)  # computes the factors of the lenslets' weights once
    prepare_s = time.perf_counter() - start_s
    displacement = reconstructor.register(frames.frame, start=before)
    slopes = displacement.coefficients * frames.sensor.slope_per_px
    weights = reconstructor.weights_of(displacement)
    zonal = ZonalSolution(slopes, displacement.valid, frames.sensor.lenslet_pitch_m, weights)
    times_s = medians_s(
        side_by_side(
            {
                "register": partial(reconstructor.register, frames.frame, start=before),
                "zonal": partial(Wavefront.of, frames.sensor, frames.field, displacement, zonal),
                "modal": partial(reconstructor.solve, displacement),
                "frame": lambda: reconstructor.solve(reconstructor.register(frames.frame, start=before)),
            },
            budget_s,
        )
    )
    values = {
        "frame_px": frames.reference.shape[0],  # along a side
        "prepare_s": prepare_s,  # from a new reference to the first wavefronts
        "register_s": times_s["register"],  # warm
        "zonal_s": times_s["zonal"],
        "modal_s": times_s["modal"],  # with the number of pupil modes chosen from the lattice
        "frame_s": times_s["frame"],  # counts to all views and coefficients: register and modal
        "per_lenslet_us": times_s["frame"] / lenslets**2 * 1e6,
        "peak_memory_mb": _peak_memory_mb(),
    }
    return CaseResult(at={"lenslets": lenslets, "field_modes": FIELD_MODES[warp]}, values=values)


def _peak_memory_mb() -> float:
    """The largest resident memory of this process so far; NaN where the system does not tell."""
    if sys.platform == "win32":
        return math.nan
    import resource  # noqa: PLC0415 - not there on Windows

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
