"""Residuals over the phase screen: its roughness, strength and place, and every method on three ensembles."""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from app.bench.config import Bench
from app.evaluation.frames import NoiseFreeFrame, NoiseFreeFrames, seeded, simulating, with_screen
from app.measurement.estimator import ROUNDS, Estimator
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.settings import ReconstructionSettings, Warp
from reconstruction.wavefront import Wavefront, mean_rms
from simulated_devices.sample import make_sample
from studies.estimators import REFINED, WARPS, compare, residual, warp_estimator, warp_estimators
from studies.tables import Asked, Made, Row, curves, draw_curves, steps

NEAR_SOURCE: dict[str, Any] = {  # the screen of the experiment, 20 mm behind the mask
    "placement": "source",
    "distance_m": 0.02,
    "correlation_length_m": 1.2e-3,
    "samples": 481,
    "sample_spacing_m": 5e-6,
}
_METHODS = {
    "zonal": ReconstructionSettings(method="zonal"),
    "modal 45": ReconstructionSettings(pupil_modes=45),
    "modal 66": ReconstructionSettings(pupil_modes=66),
    "modal 91": ReconstructionSettings(pupil_modes=91),
    "automatic": ReconstructionSettings(),
}
_DRIFT_RAD_PER_S = 0.3  # change of the wavefront, mean RMS over the views
_STEP_M = 10e-6  # screen shift that measures the change per metre


def roughness(asked: Asked, lengths_mm: Sequence[float] = (1.0, 1.25, 1.6, 2.0, 2.5, 3.0, 4.0)) -> Made:
    """Residual of every warp for rougher and smoother screens."""

    def change(bench: Bench, length_mm: float) -> Bench:
        return with_screen(bench, correlation_length_m=length_mm * 1e-3)

    table = _over_screens(asked, lengths_mm, change)
    return table, draw_curves(table, "Roughness of the screen", "correlation length (mm)", is_logarithmic=True)


def size(asked: Asked, sizes_rad: Sequence[float] = (0.5, 1.0, 2.0, 4.2, 6.0, 8.0, 10.0, 12.0, 15.0)) -> Made:
    """Residual of every warp for weak and strong wavefronts."""
    table = _over_screens(asked, sizes_rad, lambda bench, rms_rad: with_screen(bench, rms_rad=rms_rad))
    return table, draw_curves(table, "Strength of the wavefronts", "wavefront RMS (rad)", is_logarithmic=True)


def experiment(asked: Asked, sizes_rad: Sequence[float] = (5.0, 10.0, 15.0, 20.0, 30.0, 40.0)) -> Made:
    """Residual of every warp for screens 20 mm behind the mask, as in the experiment; seeds from 0 on."""

    def change(bench: Bench, rms_rad: float) -> Bench:
        return with_screen(bench, **NEAR_SOURCE, rms_rad=rms_rad)

    table = _over_screens(asked, sizes_rad, change, first_seed=0)
    return table, draw_curves(table, "Screen 20 mm behind the mask", "wavefront RMS (rad)", is_logarithmic=True)


def _over_screens(
    asked: Asked, values: Sequence[float], change: Callable[[Bench, float], Bench], first_seed: int | None = None
) -> pd.DataFrame:
    """Compare noise-free frames of the changed bench, against the reference of the unchanged one."""
    estimators = warp_estimators(asked.bench, NoiseFreeFrames(asked.bench).reference())
    rows: list[Row] = []
    for screen, value in steps(list(product(seeded(asked.bench, asked.seeds, first_seed), values)), "screens"):
        frame = NoiseFreeFrames(change(screen, value)).frame()
        rows += compare(estimators, frame.photons, frame.truth, at=value)
    return curves(rows)


def ensembles(
    asked: Asked, lengths_mm: Sequence[float] = (1.25, 1.6, 2.0), warps: Sequence[Warp] = ("translation", *WARPS)
) -> Made:
    """Residual of every warp and solve on three ensembles: one pass, over the layers found, refined, and live."""
    bench, films = asked.bench, []
    for length_mm in steps(lengths_mm, "rendering"):
        for screen in seeded(with_screen(bench, correlation_length_m=length_mm * 1e-3), asked.seeds):
            frames = NoiseFreeFrames(_drifting(screen))
            films.append((length_mm, [frames.frame(state=age_s) for age_s in reversed(range(ROUNDS + 1))]))
    reference = NoiseFreeFrames(bench).reference()
    rows: list[Row] = []
    for warp, (method, settings) in steps(list(product(warps, _METHODS.items())), "reconstructing"):
        estimator = warp_estimator(bench, reference, warp, reconstruction=settings)
        is_followed = method == "automatic" and warp in REFINED
        for length_mm, film in films:
            try:
                found = _followed(estimator, film) if is_followed else _one_pass(estimator, film[-1])
                for name, wavefront in found:
                    curve = f"{warp}, {name or method}"
                    rows.append(residual(wavefront, film[-1].truth, curve=curve, at=length_mm))
            except ReconstructionError:  # too many modes for so few lenslets
                break
    table = curves(rows)
    return table, draw_curves(table, "The ensembles", "correlation length (mm)", left_out="modal")


def _one_pass(estimator: Estimator, frame: NoiseFreeFrame) -> Iterator[tuple[str, Wavefront]]:
    reconstructor = estimator.reconstructor
    yield "", reconstructor.solve(reconstructor.register(frame.photons))


def _followed(estimator: Estimator, film: Sequence[NoiseFreeFrame]) -> Iterator[tuple[str, Wavefront]]:
    """Yield name and wavefront of one pass, over the layers found, refined, and of a live acquisition."""
    yield from _one_pass(estimator, film[-1])
    reconstructor = estimator.reconstructor
    displacement = reconstructor.register(film[-1].photons)
    sample = reconstructor.find_sample(displacement)
    yield "layers", reconstructor.solve(displacement, sample=sample)
    yield "live", _live(estimator, film, sample, is_refined=False)
    yield f"refined {ROUNDS}x", estimator.solve(displacement, sample=sample, rounds=ROUNDS)[0]
    yield "refined live, 1 s old", _live(estimator, film, sample, is_refined=True)


def _live(
    estimator: Estimator, film: Sequence[NoiseFreeFrame], sample: AssumedSample, *, is_refined: bool
) -> Wavefront:
    """Follow a film to its last frame as the acquisition does.

    Each frame is registered from the displacement of the frame before; refined, it is corrected by that frame's bias.
    """
    reconstructor = estimator.reconstructor
    displacement = reconstructor.register(film[0].photons)
    wavefront, bias = reconstructor.solve(displacement, sample=sample), None
    for frame in film[1:]:
        if is_refined:
            bias = estimator.refinement.bias(wavefront).displacement
        displacement = reconstructor.register(frame.photons, start=displacement)
        wavefront = reconstructor.solve(displacement, bias=bias, sample=sample)
    return wavefront


def _drifting(bench: Bench) -> Bench:
    """The bench with a drifting screen; its state k is k seconds old."""
    sample = make_sample(bench.simulation, bench.sensor, bench.field)
    here, there = (sample.wavefront((shift_m, shift_m)) for shift_m in (0.0, _STEP_M / math.sqrt(2)))
    speed_m_per_s = _DRIFT_RAD_PER_S / mean_rms(here - there) * _STEP_M
    # rounded, so that its frames are cached
    along_m_per_s = float(np.format_float_scientific(speed_m_per_s / math.sqrt(2), 3))
    drifting = with_screen(bench, drift_x_m_per_s=along_m_per_s, drift_y_m_per_s=along_m_per_s)
    return simulating(drifting, drifting_states=ROUNDS + 1, state_duration_s=1.0)
