"""How the time of a frame grows with the number of lenslets and of field modes, and what a 4-K camera costs."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial

from app.evaluation.benchmark.cases import Case, tiled
from app.evaluation.benchmark.stopwatch import side_by_side
from app.progress import Progress
from reconstruction.settings import FIELD_MODES, RegistrationSettings, Warp
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Wavefront

FOUR_K_LENSLETS, FOUR_K_MARGIN_PX = 64, 32  # 31 pixels each on 2048 x 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class Grown:
    """What frames of one size cost."""

    lenslets: int  # a side
    frame_px: int  # a side
    field_modes: int
    prepare_s: float  # from a new reference to the first wavefronts
    register_s: float  # warm
    zonal_s: float
    modal_s: float  # as many pupil modes as the lattice carries
    frame_s: float  # counts to all views and coefficients: register and modal
    per_lenslet_us: float  # of that
    peak_memory_mb: float  # of the whole process so far

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


def growth(case: Case, sizes: Sequence[int], budget_s: float, progress: Progress) -> list[Grown]:
    """Quadratic warps on lattices of several sizes; affine and cubic ones on that of the case itself."""
    own = case.sensor.lenslet_rows
    wanted: list[tuple[int, Warp]] = [(size, "quadratic") for size in sizes]
    wanted += [(own, "affine"), (own, "cubic")]
    found = []
    for index, (size, warp) in enumerate(wanted):
        progress(f"{size} x {size} lenslets, {warp}", index / len(wanted))
        found.append(grown(tiled(case, size), warp, budget_s))
    return found


def four_k(case: Case, budget_s: float) -> Grown:
    """A 2048 x 2048 camera behind 64 x 64 lenslets of 31 pixels."""
    return grown(tiled(case, FOUR_K_LENSLETS, margin_px=FOUR_K_MARGIN_PX), "quadratic", budget_s)


def grown(case: Case, warp: Warp, budget_s: float) -> Grown:
    """Time one size."""
    lenslets = case.sensor.lenslet_rows
    start_s = time.perf_counter()
    reconstructor = case.reconstructor(RegistrationSettings(warp=warp))
    before = reconstructor.register(case.before)
    reconstructor.solve(before)  # what the weights of the lenslets determine is computed once
    end_s = time.perf_counter()
    displacement = reconstructor.register(case.frame, start=before)
    slopes = displacement.coefficients * case.sensor.slope_per_px
    weights = reconstructor.weights_of(displacement)
    zonal = ZonalSolution(slopes, displacement.valid, case.sensor.lenslet_pitch_m, weights)
    times = side_by_side(
        {
            "register": partial(reconstructor.register, case.frame, start=before),
            "zonal": partial(Wavefront.of, case.sensor, case.field, displacement, zonal),
            "modal": partial(reconstructor.solve, displacement),
            "frame": lambda: reconstructor.solve(reconstructor.register(case.frame, start=before)),
        },
        budget_s,
    )
    frame_s = times["frame"].median_s
    return Grown(
        lenslets=lenslets,
        frame_px=case.reference.shape[0],
        field_modes=FIELD_MODES[warp],
        prepare_s=end_s - start_s,
        register_s=times["register"].median_s,
        zonal_s=times["zonal"].median_s,
        modal_s=times["modal"].median_s,
        frame_s=frame_s,
        per_lenslet_us=frame_s / lenslets**2 * 1e6,
        peak_memory_mb=_peak_memory_mb(),
    )


def _peak_memory_mb() -> float:
    """The largest resident memory of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
