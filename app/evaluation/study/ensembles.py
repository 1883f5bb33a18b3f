"""The ensembles that the project measures itself by: every warp in one pass, refined, and refined live."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from app.bench.config import Bench
from app.evaluation.noise_free import NoiseFreeFrame, NoiseFreeFrames, seeded
from app.evaluation.study.estimators import AUTOMATIC, REFINED, ROUNDS, Estimator, observed
from app.evaluation.study.observations import At, Observation, Sweep
from app.evaluation.study.screens import with_screen
from app.progress import Progress
from reconstruction.errors import ReconstructionError
from reconstruction.refinement import distance_rad
from reconstruction.settings import ReconstructionSettings, Warp
from simulated_devices.optics.ray_map import truth_wavefront
from simulated_devices.sample import make_sample

_CORRELATION_LENGTHS_M = (1.25e-3, 1.6e-3, 2.0e-3)
_WARPS: tuple[Warp, ...] = ("translation", "affine", "quadratic", "cubic")
_WAYS = {
    "zonal": ReconstructionSettings(method="zonal"),
    "modal 45": ReconstructionSettings(pupil_modes=45),
    "modal 66": ReconstructionSettings(pupil_modes=66),
    "modal 91": ReconstructionSettings(pupil_modes=91),
    "automatic": AUTOMATIC,
}
_DRIFT_RAD_PER_S = 0.3  # by which the wavefront changes, mean over the views of the RMS
_AGES_S = (1, 2)  # of the state at which the bias is found
_FILM_S = sorted({age_s * back for age_s in _AGES_S for back in range(ROUNDS + 1)})  # how long ago
_STEP_M = 10e-6  # over which the wavefront's change is measured


def _run(bench: Bench, seeds: int, progress: Progress) -> Iterator[Observation]:
    mask = bench.simulation.source.mask
    reference = NoiseFreeFrames(bench).reference(mask)
    films = []
    for index, length_m in enumerate(_CORRELATION_LENGTHS_M):
        for done, screen in enumerate(seeded(with_screen(bench, correlation_length_m=length_m), seeds)):
            progress(f"rendering {length_m * 1e3:g} mm", (index + done / seeds) / len(_CORRELATION_LENGTHS_M) / 2)
            drifting = NoiseFreeFrames(_drifting(screen))
            films.append((length_m, {seconds: drifting.frame(mask, seconds) for seconds in _FILM_S}))
    ways = [(warp, way, reconstruction) for warp in _WARPS for way, reconstruction in _WAYS.items()]
    for index, (warp, way, reconstruction) in enumerate(ways):
        progress(f"{warp}, {way}", (1 + index / len(ways)) / 2)
        try:
            estimator = Estimator(bench, reference, warp, reconstruction=reconstruction)
        except ReconstructionError:  # more modes than so few lenslets tell apart
            continue
        for length_m, film in films:
            wavefront = estimator.reconstructor(film[0].photons)
            yield observed(f"{warp}, {way}", length_m, wavefront, film[0].truth)
        if way == "automatic" and warp in REFINED:
            for length_m, film in films:
                yield from _refined(warp, estimator, length_m, film)


def _refined(
    warp: Warp, estimator: Estimator, length_m: float, film: dict[int, NoiseFreeFrame]
) -> Iterator[Observation]:
    """Refine the newest frame by itself, then by the frames before it."""
    now = film[0]
    rounds = estimator.rounds(estimator.reconstructor.register(now.photons))
    for count, (wavefront, seconds) in enumerate(rounds, 1):
        yield observed(f"{warp}, refined {count}x", length_m, wavefront, now.truth, seconds=seconds)
    for age_s in _AGES_S:
        film_of_age = [film[age_s * back] for back in reversed(range(ROUNDS + 1))]
        yield _live(f"{warp}, refined live, {age_s} s old", estimator, length_m, film_of_age)


def _live(curve: str, estimator: Estimator, length_m: float, film: Sequence[NoiseFreeFrame]) -> Observation:
    """Correct each frame by the bias found at the one before it, which was itself corrected in the same way."""
    wavefront = estimator.reconstructor(film[0].photons)
    for frame in film[1:]:
        bias = estimator.refinement.bias(wavefront)
        wavefront = estimator.reconstructor(frame.photons, bias=bias.displacement)
    return observed(curve, length_m, wavefront, film[-1].truth)


def _drifting(bench: Bench) -> Bench:
    """The bench whose screen drifts as fast as asked; state k of it is the one k seconds ago."""
    sample = make_sample(bench.simulation, bench.sensor, bench.field)
    here, there = (
        truth_wavefront(sample.screen, sample.ray_map, bench.sensor, bench.field, (shift_m, shift_m))
        for shift_m in (0.0, _STEP_M / math.sqrt(2))
    )
    speed_m_per_s = _DRIFT_RAD_PER_S / distance_rad(here, there) * _STEP_M
    along_m_per_s = float(np.format_float_scientific(speed_m_per_s / math.sqrt(2), 3))  # rounded, so to be remembered
    drifting = with_screen(bench, drift_x_m_per_s=along_m_per_s, drift_y_m_per_s=along_m_per_s)
    states = max(_AGES_S) * ROUNDS + 1
    return replace(drifting, simulation=replace(drifting.simulation, drifting_states=states, state_duration_s=1.0))


def _asked(*rms_rad: float) -> dict[At, float]:
    return dict(zip(_CORRELATION_LENGTHS_M, rms_rad, strict=True))


ENSEMBLES = Sweep(
    name="ensembles",
    title="The ensembles",
    axis="correlation length (mm)",
    axis_per_si=1e3,
    left_out=("modal", "1x", "2x", "2 s old"),
    run=_run,
    asked_rad={
        "quadratic, automatic": _asked(0.10, 0.062, 0.052),
        "cubic, refined 3x": _asked(0.031, 0.014, 0.008),
        "cubic, refined live, 1 s old": _asked(0.06, 0.03, 0.02),
    },
)
