"""Sweeps over a bench that is not what it is said to be: lattice and focal lengths wrong, lenslets dead."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from app.bench.config import Bench
from app.evaluation.noise_free import NoiseFreeFrame, NoiseFreeFrames, seeded
from app.evaluation.study.estimators import Estimators, observed
from app.evaluation.study.observations import Observation, Sweep
from app.measurement.imaging_model import by_pixel
from app.progress import Progress
from reconstruction.geometry import Lattice, nominal_lattice
from reconstruction.settings import Warp

_LATTICE_ERRORS_PX = (0.0, 0.5, 1.0, 2.0, 3.0)  # of the outermost lenslets
_FOCAL_LENGTH_ERRORS = (-0.05, -0.02, 0.0, 0.02, 0.05)
_DEAD = (0.0, 0.05, 0.1, 0.2, 0.3)

_TOLD: tuple[Warp, ...] = ("quadratic", "cubic")  # an affine one has nothing to add

_Wrong = Callable[[Bench, float], Bench]


def lattice_of(bench: Bench) -> Lattice:
    """The bench's lattice, as designed if it has none."""
    return bench.lattice or nominal_lattice(bench.sensor, bench.camera_model.rows, bench.camera_model.columns)


def _outermost_px(bench: Bench) -> float:
    """How far the outermost lenslet of the longer axis is from the middle."""
    return (max(bench.sensor.lenslet_rows, bench.sensor.lenslet_columns) - 1) / 2 * lattice_of(bench).pitch_px


def _moved(bench: Bench, error_px: float) -> Bench:
    lattice = lattice_of(bench)
    return replace(bench, lattice=replace(lattice, center_x_px=lattice.center_x_px + error_px))


def _widened(bench: Bench, error_px: float) -> Bench:
    lattice = lattice_of(bench)
    return replace(bench, lattice=replace(lattice, pitch_px=lattice.pitch_px * (1 + error_px / _outermost_px(bench))))


def _turned(bench: Bench, error_px: float) -> Bench:
    lattice = lattice_of(bench)
    return replace(bench, lattice=replace(lattice, rotation_rad=lattice.rotation_rad + error_px / _outermost_px(bench)))


def _lenslets(bench: Bench, error: float) -> Bench:
    focal_length_m = bench.sensor.lenslet_focal_length_m * (1 + error)
    return replace(bench, sensor=replace(bench.sensor, lenslet_focal_length_m=focal_length_m))


def _collimator(bench: Bench, error: float) -> Bench:
    focal_length_m = bench.field.collimator_focal_length_m * (1 + error)
    return replace(bench, field=replace(bench.field, collimator_focal_length_m=focal_length_m))


def _over(
    values: tuple[float, ...], kinds: dict[str, _Wrong]
) -> Callable[[Bench, int, Progress], Iterator[Observation]]:
    """Tell the estimators of a bench that is wrong in one way by each value; its frames are those of the right one."""

    def run(bench: Bench, seeds: int, progress: Progress) -> Iterator[Observation]:
        mask = bench.simulation.source.mask
        reference = NoiseFreeFrames(bench).reference(mask)
        frames = _frames(bench, seeds)
        told = [(kind, value, wrong) for kind, wrong in kinds.items() for value in values]
        for done, (kind, value, wrong) in enumerate(told):
            progress(f"{kind} {value:g}", done / len(told))
            estimators = Estimators(wrong(bench, value), reference, warps=_TOLD, refined=("cubic",))
            for frame in frames:
                yield from estimators.observe(frame.photons, frame.truth, value, prefix=f"{kind}: ")

    return run


def _dead(bench: Bench, seeds: int, progress: Progress) -> Iterator[Observation]:
    mask = bench.simulation.source.mask
    reference = NoiseFreeFrames(bench).reference(mask)
    shape = bench.sensor.lenslet_rows, bench.sensor.lenslet_columns
    for done, (frame, screen) in enumerate(zip(_frames(bench, seeds), seeded(bench, seeds), strict=True)):
        order = np.random.default_rng(screen.simulation.seed).permutation(shape[0] * shape[1])
        for index, fraction in enumerate(_DEAD):
            progress(f"{fraction:.0%} dead", (done + index / len(_DEAD)) / seeds)
            alive = np.ones(order.size)
            alive[order[: round(fraction * order.size)]] = 0.0
            alive = alive.reshape(shape)
            light = by_pixel(alive, lattice_of(bench), *reference.shape)
            estimators = Estimators(bench, reference * light, refined=("cubic",))
            yield from estimators.observe(frame.photons * light, frame.truth, fraction)
            if fraction > 0:
                cubic = estimators.by_warp["cubic"]
                wavefront, _ = cubic.rounds(cubic.reconstructor.register(frame.photons * light))[-1]
                yield observed(
                    "cubic refined, at the dead ones", fraction, wavefront, frame.truth, lenslets=alive == 0.0
                )


def _frames(bench: Bench, seeds: int) -> list[NoiseFreeFrame]:
    return [NoiseFreeFrames(screen).frame(bench.simulation.source.mask) for screen in seeded(bench, seeds)]


LATTICE = Sweep(
    name="lattice",
    title="Lattice wrong in centre, pitch or rotation",
    axis="error at the outermost lenslets (px)",
    run=_over(_LATTICE_ERRORS_PX, {"centre": _moved, "pitch": _widened, "rotation": _turned}),
)
FOCAL_LENGTH = Sweep(
    name="focal_length",
    title="Focal lengths wrong",
    axis="relative error",
    run=_over(_FOCAL_LENGTH_ERRORS, {"lenslets": _lenslets, "collimator": _collimator}),
)
DEAD = Sweep(name="dead", title="Dead lenslets", axis="part of all lenslets", run=_dead)
