"""Trials of the search for a layer: error of its distance, and whether its error bar covers it."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from app.bench.config import Bench
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import NoiseFreeFrames, seeded
from app.evaluation.study.camera_noise import camera
from app.evaluation.study.estimators import WarpEstimator
from app.evaluation.study_kinds import TrialStudy, trial
from app.progress import Progress, part
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layer_search import find_layers
from simulated_devices.settings import Mask

_DISTANCES_M = (0.06, 0.1, 0.195, 0.3)  # in front of the lenslets
_MASKS: tuple[Mask, ...] = ("checkerboard", "square")
_PEAK_E = 1e3  # electrons in the frame's brightest pixel
_SLOW = 1  # read-out speed with low read noise
_LIMITS = {"error over its bar": 1.0}


def _measure(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    for index, mask in enumerate(_MASKS):
        source = replace(bench.simulation.source, mask=mask)
        with_mask = replace(bench, simulation=replace(bench.simulation, source=source))
        yield from _of_mask(with_mask, seeds, part(progress, index, len(_MASKS)))


def _of_mask(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    mask, em_camera = bench.simulation.source.mask, camera(bench, _SLOW, 1.0)
    reference = NoiseFreeFrames(bench).reference(mask)
    scale = np.float32(_PEAK_E / reference.max())
    reconstructor = WarpEstimator(bench, em_camera.counts(reference * scale), None, noise=em_camera.noise).reconstructor
    screens = [(each, at_m) for each in seeded(bench, seeds) for at_m in _DISTANCES_M]
    for done, (each, at_m) in enumerate(screens):
        seed, name = each.simulation.seed, f"{mask}, {at_m * 1e3:g} mm"
        progress(f"{name}, seed {seed}", done / len(screens))
        screen = replace(each.simulation.screen, distance_m=at_m)
        frame = NoiseFreeFrames(replace(each, simulation=replace(each.simulation, screen=screen))).frame(mask)
        problem, found_m, sigma_m = "", math.nan, math.nan
        try:
            displacement = reconstructor.register(em_camera.exposed(frame.photons * scale, seed, 0))
            search = find_layers(reconstructor.layers(displacement))
            (layer,), focal_length_m = search.one.layers, bench.field.collimator_focal_length_m
            found_m, sigma_m = -layer.ratio * focal_length_m, layer.ratio_sigma * focal_length_m
        except ReconstructionError as error:
            problem = str(error)
        measured = {
            "error (%)": 100 * abs(found_m / at_m - 1),
            "too far by (%)": 100 * (found_m / at_m - 1),
            "error bar (%)": 100 * sigma_m / at_m,
            "error over its bar": abs(found_m - at_m) / sigma_m,
        }
        yield trial(case=name, name=f"seed {seed}", measured=measured, limits=_LIMITS, problem=problem)


DISTANCES = TrialStudy(
    name="distances",
    title=f"Distance of a layer, {_PEAK_E:g} electrons; 68 % as asked: within the error bar",
    measure=_measure,
)
