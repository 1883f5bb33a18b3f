"""The tables of `svwfs paper`: table 1, table 2 and the sources of the supplement."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr

from app.bench.config import Bench
from app.errors import InputError
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import seeded
from app.evaluation.paper.compared_methods import (
    METHODS,
    PAPER_TABLE_1,
    PAPER_TABLE_2,
    Method,
    MethodResult,
    reconstructed,
)
from app.evaluation.paper.frame_pairs import FramePair, Mask, exposed_frames, noise_free_frames, resized
from app.evaluation.study_kinds import LENSLETS, LIGHTS, VIEWS, ComparisonTable
from app.progress import Progress, part
from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.wavefront import rms

EXPOSURES_S: dict[Mask, float] = {"stars": 3.8, "square": 0.15}  # the paper's
SOURCES = ("square", "circle", "ellipse", "octagon", "peaks")


def table1(*, peers: bool) -> ComparisonTable:
    """Declare table 1, the paper's simulation: every method on noise-free frames, compared to the truth."""
    return ComparisonTable(
        name="table1",
        title="Simulation: residual RMS (rad) against the truth",
        measure=_in_both_lights(partial(_table1, _methods(peers=peers))),
        paper=PAPER_TABLE_1,
        compared_to="truth",
    )


def table2(*, peers: bool) -> ComparisonTable:
    """Declare table 2, the paper's experiment: noisy frames with both exposures, compared to the stars.

    Every method runs on windows at the true sub-pixel centres and (`_resized`) on frames that are cropped and resized
    as in the paper. `against_truth` compares the stars with the true wavefronts.
    """
    methods = {name: each for name, each in _methods(peers=peers).items() if each.mask == "square"}
    return ComparisonTable(
        name="table2",
        title="Experiment: residual RMS (rad) against the stars",
        measure=_in_both_lights(partial(_table2, methods)),
        paper=PAPER_TABLE_2,
        compared_to="stars",
    )


def sources() -> ComparisonTable:
    """Declare the robustness study of the paper's supplement: the same screens with sources of other shapes."""
    return ComparisonTable(
        name="sources",
        title="Other sources: residual RMS (rad) against the truth",
        measure=_in_both_lights(_sources),
        paper={},
        compared_to="truth",
    )


def _in_both_lights(
    measure: Callable[[Bench, range, Progress], Iterator[CaseResult]],
) -> Callable[[Bench, range, Progress], Iterator[CaseResult]]:
    """Measure with propagation neglected, as the paper simulates it, and in real light."""

    def in_both(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
        for index, (light, neglect) in enumerate(LIGHTS.items()):
            lit = replace(bench, field=replace(bench.field, neglect_propagation=neglect))
            for case in measure(lit, seeds, part(progress, index, len(LIGHTS))):
                yield replace(case, at={**case.at, "light": light})

    return in_both


def _table1(methods: Mapping[str, Method], bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    for index, screen in enumerate(seeded(bench, seeds)):
        step = part(progress, index, len(seeds))
        step("rendering", 0.0)
        frames, truth = noise_free_frames(screen, ("square", "stars"))
        yield from _all_compared(screen, frames, truth, methods, step)


def _table2(methods: Mapping[str, Method], bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    for index, screen in enumerate(seeded(bench, seeds)):
        step = part(progress, index, len(seeds))
        step("rendering and exposing", 0.0)
        frames, truth = exposed_frames(screen, EXPOSURES_S, lambda _: None)
        small_bench, small_frames = resized(screen, frames)
        for half, (suffix, each, its_frames) in enumerate(
            (("", screen, frames), ("_resized", small_bench, small_frames))
        ):
            stars = _stars(each, its_frames)
            yield _compared(f"stars_zonal{suffix}_against_truth", bench, stars, truth)
            named = {f"{name}{suffix}": method for name, method in methods.items()}
            yield from _all_compared(each, its_frames, stars.views, named, part(step, half, 2))


def _sources(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    kinds = [f"{warp}_{solve}" for warp in ("affine", "affine_gradient", "quadratic") for solve in ("zonal", "modal")]
    for index, screen in enumerate(seeded(bench, seeds)):
        step = part(progress, index, len(seeds))
        step("rendering", 0.0)
        frames, truth = noise_free_frames(screen, SOURCES)
        for source in SOURCES:
            methods = {f"{source}_{kind}": METHODS[kind] for kind in kinds}
            yield from _all_compared(screen, {"square": frames[source]}, truth, methods, step)


def _stars(bench: Bench, frames: Mapping[str, FramePair]) -> MethodResult:
    """The wavefronts that the experiment takes for the truth."""
    try:
        return reconstructed(bench, frames, METHODS["stars_zonal"])
    except ReconstructionError as error:
        raise InputError(f"the stars cannot be measured on this bench: {error}") from error


def _methods(*, peers: bool) -> dict[str, Method]:
    return {name: method for name, method in METHODS.items() if peers or not method.is_peer}


def _all_compared(
    bench: Bench, frames: Mapping[str, FramePair], truth: Floats, methods: Mapping[str, Method], progress: Progress
) -> Iterator[CaseResult]:
    for done, (name, method) in enumerate(methods.items()):
        progress(name, done / len(methods))
        try:
            yield _compared(name, bench, reconstructed(bench, frames, method), truth)
        except ReconstructionError as error:
            yield CaseResult(at={"method": name}, values={}, problem=str(error))


def _compared(name: str, bench: Bench, result: MethodResult, truth: Floats) -> CaseResult:
    """Return the wavefronts beside the truth; a result with an unknown view of the field has no residual."""
    x, y = bench.field.view_x_m, bench.field.view_y_m
    is_inside = bench.field.contains(x / bench.field.half_width_m, y[:, None] / bench.field.half_width_m)
    if np.isnan(rms(result.views - truth)[is_inside]).any():
        problem = f"{result.lost} lenslets are lost: a view is unknown"
        return CaseResult(at={"method": name}, values={}, problem=problem)
    views, true = (xr.DataArray(values, dims=(*VIEWS, *LENSLETS)) for values in (result.views, truth))
    scalars = {"lost": float(result.lost), "seconds": result.seconds}
    return CaseResult(at={"method": name}, values={"views": views, "truth": true, **scalars})
