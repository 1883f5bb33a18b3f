"""Residuals over light and EM gain, next to the Cramer-Rao bound."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from app.bench.config import Bench
from app.evaluation.frames import NoiseFreeFrame, NoiseFreeFrames, seeded
from app.evaluation.mask_accuracy import bound_rad, without_prior
from reconstruction.arrays import Image
from reconstruction.settings import Warp
from reconstruction.wavefront import Wavefront
from studies.estimators import FAST, SLOW, EmCamera, camera, compare, residual, row, scatter_of, warp_estimators
from studies.tables import Asked, Made, Row, curves, draw_curves, steps

_PEAKS_E = 100.0, 300.0, 1e3, 3e3, 1e4, 1e5  # electrons in the frame's brightest pixel
_LEAST_E = 300.0  # from which on scatter and bound are compared
_DRAWS = 3  # of noise for the residual of each screen
_NOISE_DRAWS = 67  # of each screen for scatter and coverage: with three screens, 200
_GAINS = 1.0, 3.0, 10.0, 30.0, 100.0, 300.0  # of the EM register
_DIM_PEAKS_E = (100.0, 300.0, 1000.0)
_UNBIASED: tuple[Warp, ...] = ("quadratic", "cubic", "quartic")


def photons(asked: Asked, peaks_e: Sequence[float] = _PEAKS_E, noise_draws: int = _NOISE_DRAWS) -> Made:
    """Residual over the light, with 8 e- of read noise; scatter and error bars next to the Cramer-Rao bound."""
    bench, rows = asked.bench, list[Row]()
    em_camera, reference = camera(bench), NoiseFreeFrames(bench).reference()
    for screen, peak_e in steps(list(product(seeded(bench, asked.seeds), peaks_e)), "light levels"):
        frame = NoiseFreeFrames(screen).frame()
        scale = np.float32(peak_e / frame.photons.max())
        estimators = warp_estimators(bench, em_camera.counts(reference * scale), noise=em_camera.noise)
        automatic = em_camera.reconstructor(bench, reference * scale)
        for draw in range(_DRAWS):
            noisy = em_camera.exposed(frame.photons * scale, screen.simulation.seed, draw)
            rows += compare(estimators, noisy, frame.truth, at=peak_e)
            rows.append(residual(automatic(noisy), frame.truth, curve="automatic warp", at=peak_e))
        if peak_e >= _LEAST_E:
            lit = replace(frame, photons=frame.photons * scale)
            rows += _next_to_bound(screen, em_camera, reference * scale, lit, at=peak_e, draws=noise_draws)
    table = curves(rows)
    axis = "electrons in the brightest pixel"
    return table, draw_curves(table, "Light, with 8 e- of read noise", axis, is_logarithmic=True)


def _next_to_bound(
    bench: Bench, em_camera: EmCamera, reference: Image, frame: NoiseFreeFrame, *, at: float, draws: int
) -> Iterator[Row]:
    """Scatter, Cramer-Rao bound and error bar of each warp, and the error bar of the automatic estimator.

    Reference and frame are in electrons, (row, column). The draws of noise are others than those of the residual.
    """

    def wavefronts() -> Iterator[Wavefront]:
        for draw in range(draws):
            yield reconstructor(em_camera.exposed(frame.photons, bench.simulation.seed, _DRAWS + draw))

    for warp in _UNBIASED:
        reconstructor = em_camera.reconstructor(bench, reference, warp, reconstruction=without_prior(bench))
        curve = f"{warp}, 45 modes"
        without = reconstructor(em_camera.counts(frame.photons))
        fields, terms = without.displacement.modes.count, reconstructor.brightness_terms
        bound = bound_rad(bench, reconstructor, field_modes=fields, brightness_terms=terms)
        scatter = scatter_of(wavefronts(), without.views)
        yield row(without, scatter.rms_rad, curve=f"{curve}: scatter", at=at)
        yield row(without, bound, curve=f"{curve}: bound", at=at)
        yield row(without, scatter.error_bar_rad, curve=f"{curve}: error bar", at=at, coverage=scatter.coverage)
    reconstructor = em_camera.reconstructor(bench, reference)
    scatter, without = scatter_of(wavefronts(), frame.truth), reconstructor(em_camera.counts(frame.photons))
    yield row(without, scatter.error_bar_rad, curve="automatic warp: error bar", at=at, coverage=scatter.coverage)


def em_gain(asked: Asked, gains: Sequence[float] = _GAINS) -> Made:
    """Residual over the gain of the EM register, quadratic warp, one pass."""
    bench, rows = asked.bench, list[Row]()
    settings = [(f"37 e- read noise, {peak_e:g} e-", FAST, gain, peak_e) for peak_e in _DIM_PEAKS_E for gain in gains]
    settings += [(f"8 e- read noise, {peak_e:g} e-", SLOW, 1.0, peak_e) for peak_e in _DIM_PEAKS_E]
    reference = NoiseFreeFrames(bench).reference()
    for screen, (curve, speed, gain, peak_e) in steps(list(product(seeded(bench, asked.seeds), settings)), "gains"):
        frame, em_camera = NoiseFreeFrames(screen).frame(), camera(bench, speed, gain)
        scale = np.float32(peak_e / frame.photons.max())
        reconstructor = em_camera.reconstructor(bench, reference * scale, "quadratic")
        for draw in range(_DRAWS):
            wavefront = reconstructor(em_camera.exposed(frame.photons * scale, screen.simulation.seed, draw))
            rows.append(residual(wavefront, frame.truth, curve=curve, at=gain))
    table = curves(rows)
    return table, draw_curves(table, "Gain of the register (quadratic)", "gain", is_logarithmic=True)
