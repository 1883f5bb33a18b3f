"""Sweeps over the phase screen: strength, roughness, distance, and the ensembles of the project's goals.

The ensembles are measured with every warp in one pass, then over the layers found, refined, and refined live.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from app.bench.config import Bench
from app.evaluation.cases import CaseResult, Position
from app.evaluation.noise_free import NoiseFreeFrame, NoiseFreeFrames, seeded
from app.evaluation.study.estimators import AUTOMATIC, REFINED, ROUNDS, WarpEstimator, WarpEstimators, compared
from app.evaluation.study_kinds import Sweep
from app.progress import Progress
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.refinement import distance_rad
from reconstruction.settings import ReconstructionSettings, Warp
from reconstruction.wavefront import Wavefront
from simulated_devices.sample import make_sample

# The screen of the experiment, 20 mm behind the mask.
_EXPERIMENT: dict[str, Any] = {
    "placement": "source",
    "distance_m": 0.02,
    "correlation_length_m": 1.2e-3,
    "samples": 481,
    "sample_spacing_m": 5e-6,
}
_EXPERIMENT_FIRST_SEED = 0
_CORRELATION_LENGTHS_M = (1.25e-3, 1.6e-3, 2.0e-3)
_WARPS: tuple[Warp, ...] = ("translation", "affine", "quadratic", "cubic", "quartic")
_METHODS = {
    "zonal": ReconstructionSettings(method="zonal"),
    "modal 45": ReconstructionSettings(pupil_modes=45),
    "modal 66": ReconstructionSettings(pupil_modes=66),
    "modal 91": ReconstructionSettings(pupil_modes=91),
    "automatic": AUTOMATIC,
}
_DRIFT_RAD_PER_S = 0.3  # change of the wavefront, mean RMS over the views
_AGES_S = (1, 2)  # of the bias
_FILM_S = sorted({age_s * back for age_s in _AGES_S for back in range(ROUNDS + 1)})  # ages of the frames
_STEP_M = 10e-6  # screen shift that measures the change per metre


def with_screen(bench: Bench, **changes: Any) -> Bench:
    """Return the bench with a changed screen."""
    screen = replace(bench.simulation.screen, **changes)
    return replace(bench, simulation=replace(bench.simulation, screen=screen))


def _over(
    values: tuple[float, ...], change: Callable[[Bench, float], Bench], first_seed: int | None = None
) -> Callable[[Bench, range, Progress], Iterator[CaseResult]]:
    """Measure noise-free frames of the bench changed by each value, against the reference of the unchanged bench."""

    def measure(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
        mask = bench.simulation.source.mask
        estimators = WarpEstimators(bench, NoiseFreeFrames(bench).reference(mask))
        for done, screen in enumerate(seeded(bench, seeds, first_seed)):
            for index, value in enumerate(values):
                progress(f"{value:g}", (done + index / len(values)) / len(seeds))
                frames = NoiseFreeFrames(change(screen, value))
                frame = frames.frame(mask)
                yield from estimators.compare(frame.photons, frame.truth, value, sample=frames.sample)

    return measure


def _ensembles(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    mask = bench.simulation.source.mask
    reference = NoiseFreeFrames(bench).reference(mask)
    films = []
    for index, length_m in enumerate(_CORRELATION_LENGTHS_M):
        for done, screen in enumerate(seeded(with_screen(bench, correlation_length_m=length_m), seeds)):
            progress(f"rendering {length_m * 1e3:g} mm", (index + done / len(seeds)) / len(_CORRELATION_LENGTHS_M) / 2)
            drifting = NoiseFreeFrames(_drifting(screen))
            films.append((length_m, {seconds: drifting.frame(mask, seconds) for seconds in _FILM_S}))
    methods = [(warp, method, reconstruction) for warp in _WARPS for method, reconstruction in _METHODS.items()]
    for index, (warp, method, reconstruction) in enumerate(methods):
        progress(f"{warp}, {method}", (1 + index / len(methods)) / 2)
        try:
            estimator = WarpEstimator(bench, reference, warp, reconstruction=reconstruction)
        except ReconstructionError:  # too many modes for so few lenslets
            continue
        for length_m, film in films:
            wavefront = estimator.reconstructor.solve(estimator.reconstructor.register(film[0].photons))
            yield compared(f"{warp}, {method}", length_m, wavefront, film[0].truth)
        if method == "automatic" and warp in REFINED:
            for length_m, film in films:
                yield from _refined(warp, estimator, length_m, film)


def _refined(
    warp: Warp, estimator: WarpEstimator, length_m: float, film: dict[int, NoiseFreeFrame]
) -> Iterator[CaseResult]:
    """Follow a film in one pass over the layers found; refine the newest frame by itself, then by those before it."""
    newest, reconstructor = film[0], estimator.reconstructor
    displacement = reconstructor.register(newest.photons)
    sample = reconstructor.find_sample(displacement)
    yield compared(f"{warp}, layers", length_m, reconstructor.solve(displacement, sample=sample), newest.truth)
    wavefront = _one_pass_live(estimator, [film[seconds] for seconds in reversed(_FILM_S)], sample)
    yield compared(f"{warp}, live", length_m, wavefront, newest.truth)
    rounds = estimator.rounds(displacement, sample=sample)
    for count, (wavefront, seconds) in enumerate(rounds, 1):
        yield compared(f"{warp}, refined {count}x", length_m, wavefront, newest.truth, seconds=seconds)
    for age_s in _AGES_S:
        frames = [film[age_s * back] for back in reversed(range(ROUNDS + 1))]
        wavefront = _refined_live(estimator, frames, sample)
        yield compared(f"{warp}, refined live, {age_s} s old", length_m, wavefront, newest.truth)


def _one_pass_live(estimator: WarpEstimator, film: Sequence[NoiseFreeFrame], sample: AssumedSample) -> Wavefront:
    """Register each frame from the displacement of the one before it, as the acquisition does."""
    displacement = estimator.reconstructor.register(film[0].photons)
    for frame in film[1:]:
        displacement = estimator.reconstructor.register(frame.photons, start=displacement)
    return estimator.reconstructor.solve(displacement, sample=sample)


def _refined_live(estimator: WarpEstimator, film: Sequence[NoiseFreeFrame], sample: AssumedSample) -> Wavefront:
    """Correct each frame by the bias of the one before it, which was itself corrected in the same way."""
    reconstructor, refinement = estimator.reconstructor, estimator.refinement
    wavefront = reconstructor.solve(reconstructor.register(film[0].photons), sample=sample)
    for frame in film[1:]:
        displacement, bias = reconstructor.register(frame.photons), refinement.bias(wavefront)
        wavefront = reconstructor.solve(displacement, bias=bias.displacement, sample=sample)
    return wavefront


def _drifting(bench: Bench) -> Bench:
    """The bench with a drifting screen; its state k is k seconds old."""
    sample = make_sample(bench.simulation, bench.sensor, bench.field)
    here, there = (
        sample.wavefront(bench.sensor, bench.field, (shift_m, shift_m)) for shift_m in (0.0, _STEP_M / math.sqrt(2))
    )
    speed_m_per_s = _DRIFT_RAD_PER_S / distance_rad(here, there) * _STEP_M
    along_m_per_s = float(
        np.format_float_scientific(speed_m_per_s / math.sqrt(2), 3)
    )  # rounded, so that its frames are cached
    drifting = with_screen(bench, drift_x_m_per_s=along_m_per_s, drift_y_m_per_s=along_m_per_s)
    states = max(_AGES_S) * ROUNDS + 1
    return replace(drifting, simulation=replace(drifting.simulation, drifting_states=states, state_duration_s=1.0))


def _limits(*rms_rad: float) -> dict[Position, float]:
    return dict(zip(_CORRELATION_LENGTHS_M, rms_rad, strict=True))


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
ENSEMBLES = Sweep(
    name="ensembles",
    title="The ensembles",
    axis="correlation length (mm)",
    axis_per_si=1e3,
    left_out=("modal", "1x", "2x", "2 s old"),
    measure=_ensembles,
    limits_rad={
        "quartic, layers": _limits(0.055, 0.036, 0.026)  # of the preset's square
    },
)
