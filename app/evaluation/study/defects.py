"""Sweeps over a bench that differs from its settings: wrong lattice, wrong focal lengths, dead lenslets."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from app.bench.config import Bench
from app.bench.imaging_model import by_pixel
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import NoiseFreeFrame, NoiseFreeFrames, seeded
from app.evaluation.study.estimators import WarpEstimators, compared
from app.evaluation.study_kinds import Sweep
from app.progress import Progress
from reconstruction.geometry import Lattice
from reconstruction.settings import Warp

_DEAD = (0.0, 0.05, 0.1, 0.2, 0.3)
_WARPS: tuple[Warp, ...] = ("quadratic", "cubic")  # affine adds no information

_Error = Callable[[Bench, float], Bench]  # returns the bench with a wrong setting


def _lattice(bench: Bench) -> Lattice:
    return bench.design_lattice(bench.camera_model.rows, bench.camera_model.columns)


def _with_lattice(bench: Bench, name: str, change: Callable[[float, float], float]) -> Bench:
    """Change one number of the lattice; `change` gets it and the distance of the outermost lenslet, px."""
    lattice, lenslets = _lattice(bench), max(bench.sensor.lenslet_rows, bench.sensor.lenslet_columns)
    changed: Any = change(getattr(lattice, name), (lenslets - 1) / 2 * lattice.pitch_px)
    return replace(bench, lattice=replace(lattice, **{name: changed}))


def _other_lenslets(bench: Bench, error: float) -> Bench:
    focal_length_m = bench.sensor.lenslet_focal_length_m * (1 + error)
    return replace(bench, sensor=replace(bench.sensor, lenslet_focal_length_m=focal_length_m))


def _other_collimator(bench: Bench, error: float) -> Bench:
    focal_length_m = bench.field.collimator_focal_length_m * (1 + error)
    return replace(bench, field=replace(bench.field, collimator_focal_length_m=focal_length_m))


def _over(
    values: tuple[float, ...], errors: dict[str, _Error]
) -> Callable[[Bench, range, Progress], Iterator[CaseResult]]:
    """Reconstruct frames of the right bench with the settings of a wrong one, for each kind and size of error."""

    def measure(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
        reference = NoiseFreeFrames(bench).reference(bench.simulation.source.mask)
        frames = _frames(bench, seeds)
        cases = [(kind, value, wrong) for kind, wrong in errors.items() for value in values]
        for done, (kind, value, wrong) in enumerate(cases):
            progress(f"{kind} {value:g}", done / len(cases))
            estimators = WarpEstimators(wrong(bench, value), reference, warps=_WARPS, refined=("cubic",))
            for frame in frames:
                yield from estimators.compare(frame.photons, frame.truth, value, prefix=f"{kind}: ")

    return measure


def _dead(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    reference = NoiseFreeFrames(bench).reference(bench.simulation.source.mask)
    shape = bench.sensor.lenslet_rows, bench.sensor.lenslet_columns
    for done, (frame, screen) in enumerate(zip(_frames(bench, seeds), seeded(bench, seeds), strict=True)):
        order = np.random.default_rng(screen.simulation.seed).permutation(shape[0] * shape[1])
        for index, fraction in enumerate(_DEAD):
            progress(f"{fraction:.0%} dead", (done + index / len(_DEAD)) / len(seeds))
            alive = np.ones(order.size)
            alive[order[: round(fraction * order.size)]] = 0.0
            alive = alive.reshape(shape)
            light = by_pixel(alive, _lattice(bench), *reference.shape)
            estimators = WarpEstimators(bench, reference * light, refined=("cubic",))
            yield from estimators.compare(frame.photons * light, frame.truth, fraction)
            if fraction > 0:
                cubic, curve = estimators.by_warp["cubic"], "cubic refined, at the dead ones"
                wavefront, _ = cubic.rounds(cubic.reconstructor.register(frame.photons * light))[-1]
                yield compared(curve, fraction, wavefront, frame.truth, lenslets=alive == 0.0)


def _frames(bench: Bench, seeds: range) -> list[NoiseFreeFrame]:
    return [NoiseFreeFrames(screen).frame(bench.simulation.source.mask) for screen in seeded(bench, seeds)]


_LATTICE_ERRORS: dict[str, _Error] = {  # by the shift of the outermost lenslets
    "centre": lambda bench, px: _with_lattice(bench, "center_x_px", lambda center_px, _: center_px + px),
    "pitch": lambda bench, px: _with_lattice(bench, "pitch_px", lambda pitch_px, far_px: pitch_px * (1 + px / far_px)),
    "rotation": lambda bench, px: _with_lattice(bench, "rotation_rad", lambda angle, far_px: angle + px / far_px),
}
LATTICE = Sweep(
    name="lattice",
    title="Lattice wrong in centre, pitch or rotation",
    axis="error at the outermost lenslets (px)",
    measure=_over((0.0, 0.5, 1.0, 2.0, 3.0), _LATTICE_ERRORS),
)
FOCAL_LENGTH = Sweep(
    name="focal_length",
    title="Focal lengths wrong",
    axis="relative error",
    measure=_over((-0.05, -0.02, 0.0, 0.02, 0.05), {"lenslets": _other_lenslets, "collimator": _other_collimator}),
)
DEAD = Sweep(name="dead", title="Dead lenslets", axis="part of all lenslets", measure=_dead)
