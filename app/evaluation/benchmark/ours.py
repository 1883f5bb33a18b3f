"""What this instrument makes of the frames: from counts to the wavefronts of all views and their coefficients."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import product

import numpy as np

from app.evaluation.benchmark.cases import Case
from reconstruction.arrays import Floats
from reconstruction.settings import RegistrationSettings, Warp
from reconstruction.wavefront import Wavefront

WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic")
THREADS = (1, 2)


def name_of(warp: Warp, *, is_warm: bool, threads: int) -> str:
    """The name of one way to use it."""
    return f"{warp}, {'warm' if is_warm else 'cold'}, {threads} thread{'s' * (threads > 1)}"


OURS = name_of("quadratic", is_warm=True, threads=2)
OURS_ONE_THREAD = name_of("quadratic", is_warm=True, threads=1)


def ours(case: Case) -> Iterator[tuple[str, Callable[[], Wavefront]]]:
    """Every warp, from nothing and from the frame before, in one thread and in two."""
    for warp, threads in product(WARPS, THREADS):
        reconstructor = case.reconstructor(RegistrationSettings(warp=warp, threads=threads))
        before = reconstructor.register(case.before)
        for is_warm in (False, True):
            start = before if is_warm else None
            yield (
                name_of(warp, is_warm=is_warm, threads=threads),
                lambda reconstructor=reconstructor, start=start: reconstructor.solve(  # type: ignore[misc] # bound now
                    reconstructor.register(case.frame, start=start)
                ),
            )


def coefficients_of(wavefront: Wavefront) -> Floats:
    """The displacements that a wavefront is made of, px, (lenslet, xy, field_mode)."""
    found = wavefront.displacement.coefficients
    return np.swapaxes(found.reshape(-1, *found.shape[2:]), 1, 2)


def frames_per_s(case: Case, seconds: float) -> float:
    """How many frames pass in a loop, each begun where the one before lay."""
    reconstructor = case.reconstructor(RegistrationSettings(warp="quadratic"))
    displacement = reconstructor.register(case.before)
    frames, start_s = 0, time.perf_counter()
    while time.perf_counter() < start_s + seconds:
        for frame in (case.frame, case.before):
            displacement = reconstructor.register(frame, start=displacement)
            reconstructor.solve(displacement)
            frames += 1
    return frames / (time.perf_counter() - start_s)
