"""Our reconstruction as contestant: from counts to the wavefronts of all views and their coefficients."""

import time
from collections.abc import Callable, Iterator
from itertools import product

import numpy as np

from app.evaluation.benchmark.timed_frames import TimedFrames
from reconstruction.arrays import Floats
from reconstruction.settings import RegistrationSettings, Warp
from reconstruction.wavefront import Wavefront

WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic")
THREADS = (1, 2)


def name_of(warp: Warp, *, is_warm: bool, threads: int) -> str:
    """Return the name of a contestant."""
    return f"{warp}, {'warm' if is_warm else 'cold'}, {threads} thread{'s' * (threads > 1)}"


OURS = name_of("quadratic", is_warm=True, threads=2)
OURS_ONE_THREAD = name_of("quadratic", is_warm=True, threads=1)


def ours(frames: TimedFrames) -> Iterator[tuple[str, Callable[[], Wavefront]]]:
    """Yield name and call of every warp, cold and warm (started at the previous frame), in one and two threads."""
    for warp, threads in product(WARPS, THREADS):
        reconstructor = frames.reconstructor(RegistrationSettings(warp=warp, threads=threads))
        before = reconstructor.register(frames.before)
        for is_warm in (False, True):
            start = before if is_warm else None
            yield (
                name_of(warp, is_warm=is_warm, threads=threads),
                lambda reconstructor=reconstructor, start=start: reconstructor.solve(  # type: ignore[misc] # bound now
                    reconstructor.register(frames.frame, start=start)
                ),
            )


def coefficients_of(wavefront: Wavefront) -> Floats:
    """Return the displacements of a wavefront, px, (lenslet, xy, field_mode)."""
    found = wavefront.displacement.coefficients
    return np.swapaxes(found.reshape(-1, *found.shape[2:]), 1, 2)


def frames_per_s(frames: TimedFrames, seconds: float) -> float:
    """Return the rate of a loop of warm frames."""
    reconstructor = frames.reconstructor(RegistrationSettings(warp="quadratic"))
    displacement = reconstructor.register(frames.before)
    count, start_s = 0, time.perf_counter()
    while time.perf_counter() < start_s + seconds:
        for frame in (frames.frame, frames.before):
            displacement = reconstructor.register(frame, start=displacement)
            reconstructor.solve(displacement)
            count += 1
    return count / (time.perf_counter() - start_s)
