"""Layers of the sample: how well their distances are found, and what correctors leave."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from app.acquisition.devices import scene_of
from app.bench.config import Bench
from app.evaluation.frames import NoiseFreeFrames, seeded, with_screen, with_source
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import centered_steps
from reconstruction.layers.corrector import Correction, Corrector, best_correction, field_positions_m
from reconstruction.layers.layer_search import search_layers
from reconstruction.wavefront import Wavefront, rms
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.rendering import Renderer
from simulated_devices.settings import Mask
from studies.estimators import camera, row
from studies.layered_light import LayeredLight, PlacedScreen, layer_of
from studies.tables import Asked, Made, Row, curves, draw_curves, steps, trial, trials

_DISTANCES_M = 0.06, 0.1, 0.195, 0.3  # in front of the lenslets
_MASKS: tuple[Mask, ...] = "checkerboard", "square"
_PEAK_E = 1e3  # electrons in the frame's brightest pixel
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25)  # of the screen's distance
_CORRECTORS = (Corrector("zernike", 10), Corrector("zernike", 45))
_SPACING_M = 25e-6  # of the samples of the corrector's phase
_MARGIN = 4  # of them around its footprint


def distances(asked: Asked, distances_m: Sequence[float] = _DISTANCES_M) -> Made:
    """Error of the distance of a layer; 68 % should be as asked, within their error bar."""
    rows: list[Row] = []
    for mask in _MASKS:
        bench = with_source(asked.bench, mask=mask)
        em_camera, reference = camera(bench), NoiseFreeFrames(bench).reference()
        scale, focal_length_m = np.float32(_PEAK_E / reference.max()), bench.field.collimator_focal_length_m
        reconstructor, focal_length_m = (
            em_camera.reconstructor(bench, reference * scale),
            bench.field.collimator_focal_length_m,
        )
        for screen, at_m in steps(list(product(seeded(bench, asked.seeds), distances_m)), mask):
            frame = NoiseFreeFrames(with_screen(screen, distance_m=at_m)).frame()
            problem, found_m, sigma_m = "", math.nan, math.nan
            try:
                noisy = em_camera.exposed(frame.photons * scale, screen.simulation.seed, 0)
                (layer,) = search_layers(reconstructor.layers(reconstructor.register(noisy))).one.layers
                found_m, sigma_m = -layer.ratio * focal_length_m, layer.ratio_sigma * focal_length_m
            except ReconstructionError as error:
                problem = str(error)
            measured = {
                "error (%)": 100 * abs(found_m / at_m - 1),
                "too far by (%)": 100 * (found_m / at_m - 1),
                "error bar (%)": 100 * sigma_m / at_m,
                "error over its bar": abs(found_m - at_m) / sigma_m,
            }
            rows.append(trial(f"{mask}, {at_m * 1e3:g} mm", measured, {"error over its bar": 1.0}, problem))
    return trials(rows, f"Distance of a layer, {_PEAK_E:g} electrons")


def corrector(asked: Asked, shares: Sequence[float] = _SHARES) -> Made:
    """Residual over the field after the best command of a corrector, as predicted and in frames through it."""
    distance_m = asked.bench.simulation.screen.distance_m
    cases = [(each, share * distance_m) for each in _CORRECTORS for share in shares]
    screens = steps(seeded(asked.bench, asked.seeds), "screens")
    table = curves(each for screen in screens for each in predicted_and_simulated(screen, cases))
    axis = "distance of the corrector from the lenslets (mm)"
    return table, draw_curves(table, "Best command of a corrector: residual over the field", axis)


def predicted_and_simulated(bench: Bench, cases: Sequence[tuple[Corrector, float]]) -> Iterator[Row]:
    """Yield the residuals of correctors at distances from the lenslets, m.

    They are predicted from one frame, then simulated. The frame through a corrector is rendered with its best command
    as a second screen at its distance.
    """
    mask, em_camera, positions_m = bench.simulation.source.mask, camera(bench), field_positions_m(bench.field)
    renderer = Renderer(replace(scene_of(bench), lines=()))  # a corrector's phase is known at one wavelength
    reference, frame = renderer.reference(mask), renderer.state(mask, 0)
    scale = np.float32(_PEAK_E / frame.max())
    reconstructor = em_camera.reconstructor(bench, reference * scale)

    def measured(irradiance: Image, draw: int) -> tuple[Wavefront, Floats]:
        """Wavefront of a noisy frame, and its phases at the field positions."""
        wavefront = reconstructor(em_camera.exposed(irradiance * scale, bench.simulation.seed, draw))
        return wavefront, np.array([wavefront.at(x_m, y_m) for x_m, y_m in positions_m])

    without, before = measured(frame, 0)
    for index, (tried, at_m) in enumerate(cases, 1):
        name, ratio = (
            f"{tried.count} {tried.influence.capitalize()} modes",
            -at_m / bench.field.collimator_focal_length_m,
        )
        made = best_correction(
            before, positions_m=positions_m, sensor=bench.sensor, field=bench.field, ratio=ratio, corrector=tried
        )
        corrected, after = measured(_through(renderer, mask, made), index)
        simulated_rad = float(np.sqrt(np.nanmean(rms(after) ** 2)))
        yield row(without, made.mean_residual_rad, curve=f"{name}, predicted", at=at_m * 1e3)
        yield row(corrected, simulated_rad, curve=f"{name}, simulated", at=at_m * 1e3)


def _through(renderer: Renderer, mask: str, made: Correction) -> Image:
    """Irradiance (row, column), m^2, with the sample and a corrector."""
    scene, model = renderer.scene, renderer.model
    focal_length_m = scene.field.collimator_focal_length_m
    border_m = scene.simulation.border_lenslets * scene.sensor.lenslet_pitch_m
    x_m, y_m = (
        centered_steps(2 * (int((half_m + border_m) / _SPACING_M) + _MARGIN) + 1) * _SPACING_M
        for half_m in made.half_width_m
    )
    phase = PhaseScreen(made.phase(x_m, y_m[:, None]), _SPACING_M)
    corrector = PlacedScreen(phase=phase, distance_m=-made.ratio * focal_length_m)
    light = LayeredLight(
        [layer_of(renderer.sample), corrector],
        scene.sensor,
        scene.field,
        pupil_half_width_m=(float(model.sample_x_m.max()), float(model.sample_y_m.max())),
    )
    return model.irradiance(renderer.points(mask), light.field(model.sample_x_m, model.sample_y_m))
