"""Sweep over the ensembles of the project's goals: every warp in one pass, refined, and refined live."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from app.bench.config import Bench
from app.evaluation.cases import CaseResult, Position
from app.evaluation.noise_free import NoiseFreeFrame, NoiseFreeFrames, seeded
from app.evaluation.study.estimators import AUTOMATIC, REFINED, ROUNDS, WarpEstimator, compared
from app.evaluation.study.screens import with_screen
from app.evaluation.study_kinds import Sweep
from app.progress import Progress
from reconstruction.errors import ReconstructionError
from reconstruction.refinement import distance_rad
from reconstruction.settings import ReconstructionSettings, Warp
from reconstruction.wavefront import Wavefront
from simulated_devices.optics.ray_map import truth_wavefront
from simulated_devices.sample import make_sample

_CORRELATION_LENGTHS_M = (1.25e-3, 1.6e-3, 2.0e-3)
_WARPS: tuple[Warp, ...] = ("translation", "affine", "quadratic", "cubic")
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


def _measure(bench: Bench, seeds: int, progress: Progress) -> Iterator[CaseResult]:
    mask = bench.simulation.source.mask
    reference = NoiseFreeFrames(bench).reference(mask)
    films = []
    for index, length_m in enumerate(_CORRELATION_LENGTHS_M):
        for done, screen in enumerate(seeded(with_screen(bench, correlation_length_m=length_m), seeds)):
            progress(f"rendering {length_m * 1e3:g} mm", (index + done / seeds) / len(_CORRELATION_LENGTHS_M) / 2)
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
            yield compared(f"{warp}, {method}", length_m, estimator.reconstructor(film[0].photons), film[0].truth)
        if method == "automatic" and warp in REFINED:
            for length_m, film in films:
                yield from _refined(warp, estimator, length_m, film)


def _refined(
    warp: Warp, estimator: WarpEstimator, length_m: float, film: dict[int, NoiseFreeFrame]
) -> Iterator[CaseResult]:
    """Refine the newest frame by itself, then by the frames before it."""
    newest = film[0]
    rounds = estimator.rounds(estimator.reconstructor.register(newest.photons))
    for count, (wavefront, seconds) in enumerate(rounds, 1):
        yield compared(f"{warp}, refined {count}x", length_m, wavefront, newest.truth, seconds=seconds)
    for age_s in _AGES_S:
        frames = [film[age_s * back] for back in reversed(range(ROUNDS + 1))]
        wavefront = _refined_live(estimator, frames)
        yield compared(f"{warp}, refined live, {age_s} s old", length_m, wavefront, newest.truth)


def _refined_live(estimator: WarpEstimator, film: Sequence[NoiseFreeFrame]) -> Wavefront:
    """Correct each frame by the bias of the one before it, which was itself corrected in the same way."""
    wavefront = estimator.reconstructor(film[0].photons)
    for frame in film[1:]:
        bias = estimator.refinement.bias(wavefront)
        wavefront = estimator.reconstructor(frame.photons, bias=bias.displacement)
    return wavefront


def _drifting(bench: Bench) -> Bench:
    """The bench with a drifting screen; its state k is k seconds old."""
    sample = make_sample(bench.simulation, bench.sensor, bench.field)
    here, there = (
        truth_wavefront(sample.screen, sample.ray_map, bench.sensor, bench.field, (shift_m, shift_m))
        for shift_m in (0.0, _STEP_M / math.sqrt(2))
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


ENSEMBLES = Sweep(
    name="ensembles",
    title="The ensembles",
    axis="correlation length (mm)",
    axis_per_si=1e3,
    left_out=("modal", "1x", "2x", "2 s old"),
    measure=_measure,
    limits_rad={
        "quadratic, automatic": _limits(0.10, 0.062, 0.052),
        "cubic, refined 3x": _limits(0.031, 0.014, 0.008),
        "cubic, refined live, 1 s old": _limits(0.06, 0.03, 0.02),
    },
)
