"""Sweeps over the phase screen: strength, roughness, distance from the source."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from app.bench.config import Bench
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import NoiseFreeFrames, seeded
from app.evaluation.study.estimators import WarpEstimators
from app.evaluation.study_kinds import Sweep
from app.progress import Progress

# The screen of the experiment, 20 mm behind the mask.
_EXPERIMENT: dict[str, Any] = {
    "placement": "source",
    "distance_m": 0.02,
    "correlation_length_m": 1.2e-3,
    "samples": 481,
    "sample_spacing_m": 5e-6,
}
_EXPERIMENT_FIRST_SEED = 0


def with_screen(bench: Bench, **changes: Any) -> Bench:
    """Return the bench with a changed screen."""
    screen = replace(bench.simulation.screen, **changes)
    return replace(bench, simulation=replace(bench.simulation, screen=screen))


def _over(
    values: tuple[float, ...], change: Callable[[Bench, float], Bench], first_seed: int | None = None
) -> Callable[[Bench, int, Progress], Iterator[CaseResult]]:
    """Measure noise-free frames of the bench changed by each value, against the reference of the unchanged bench."""

    def measure(bench: Bench, seeds: int, progress: Progress) -> Iterator[CaseResult]:
        mask = bench.simulation.source.mask
        estimators = WarpEstimators(bench, NoiseFreeFrames(bench).reference(mask))
        for done, screen in enumerate(seeded(bench, seeds, first_seed)):
            for index, value in enumerate(values):
                progress(f"{value:g}", (done + index / len(values)) / seeds)
                frames = NoiseFreeFrames(change(screen, value))
                frame = frames.frame(mask)
                yield from estimators.compare(frame.photons, frame.truth, value, sample=frames.sample)

    return measure


SIZE = Sweep(
    name="size",
    title="Strength of the wavefronts",
    axis="wavefront RMS (rad)",
    measure=_over(
        (0.5, 1.0, 2.0, 4.2, 6.0, 8.0, 10.0, 12.0, 15.0), lambda bench, rms_rad: with_screen(bench, rms_rad=rms_rad)
    ),
    is_logarithmic=True,
)
ROUGHNESS = Sweep(
    name="roughness",
    title="Roughness of the screen",
    axis="correlation length (mm)",
    axis_per_si=1e3,
    measure=_over(
        (1.0e-3, 1.25e-3, 1.6e-3, 2.0e-3, 2.5e-3, 3.0e-3, 4.0e-3),
        lambda bench, length_m: with_screen(bench, correlation_length_m=length_m),
    ),
    is_logarithmic=True,
)
EXPERIMENT = Sweep(
    name="experiment",
    title="Screen 20 mm behind the mask",
    axis="wavefront RMS (rad)",
    measure=_over(
        (5.0, 10.0, 15.0, 20.0, 30.0, 40.0),
        lambda bench, rms_rad: with_screen(bench, **_EXPERIMENT, rms_rad=rms_rad),
        _EXPERIMENT_FIRST_SEED,
    ),
    is_logarithmic=True,
)
