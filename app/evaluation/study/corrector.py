"""Sweep over the distance of a corrector: the residual predicted from one frame, and that of a frame through it.

The frame through the corrector is rendered with its best command as a second screen at its distance.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from app.acquisition.devices import scene_of
from app.bench.config import Bench
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import seeded
from app.evaluation.study.camera_noise import camera
from app.evaluation.study.estimators import WarpEstimator, with_rms
from app.evaluation.study_kinds import Sweep
from app.progress import Progress, part
from reconstruction.arrays import Floats, Image
from reconstruction.geometry import centered_steps
from reconstruction.layers.corrector import Correction, Corrector, best_correction, field_positions_m
from reconstruction.wavefront import Wavefront, rms
from simulated_devices.optics.layered_light import Layer, LayeredLight
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.rendering import Renderer

_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25)  # of the screen's distance
_CORRECTORS = (Corrector("zernike", 10), Corrector("zernike", 45))
_PEAK_E = 1e3  # electrons in the frame's brightest pixel
_SLOW = 1  # read-out speed with low read noise
_SPACING_M = 25e-6  # of the samples of the corrector's phase
_MARGIN = 4  # of them around its footprint
_AGREEMENT = 0.1  # of the prediction


def _measure(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    cases = [(corrector, share * bench.simulation.screen.distance_m) for corrector in _CORRECTORS for share in _SHARES]
    for done, each in enumerate(seeded(bench, seeds)):
        yield from predicted_and_simulated(each, cases, part(progress, done, len(seeds)))


def predicted_and_simulated(
    bench: Bench, cases: Sequence[tuple[Corrector, float]], progress: Progress
) -> Iterator[CaseResult]:
    """Yield the residuals of correctors at distances from the lenslets, m, predicted first."""
    mask, em_camera, positions_m = (
        bench.simulation.source.mask,
        camera(bench, _SLOW, 1.0),
        field_positions_m(bench.field),
    )
    renderer = Renderer(scene_of(bench))
    reference, frame = renderer.reference(mask), renderer.state(mask, 0)
    scale = np.float32(_PEAK_E / frame.max())
    estimator = WarpEstimator(bench, em_camera.counts(reference * scale), None, noise=em_camera.noise)

    def measured(irradiance: Image, draw: int) -> tuple[Wavefront, Floats]:
        """Wavefront of a noisy frame, and its phases at the field positions."""
        wavefront = estimator.reconstructor(em_camera.exposed(irradiance * scale, bench.simulation.seed, draw))
        return wavefront, np.array([wavefront.at(x_m, y_m) for x_m, y_m in positions_m])

    without, before = measured(frame, 0)
    for index, (corrector, at_m) in enumerate(cases, 1):
        name = f"{corrector.count} {corrector.influence.capitalize()} modes"
        progress(f"{name} at {at_m * 1e3:.0f} mm", (index - 1) / len(cases))
        ratio = -at_m / bench.field.collimator_focal_length_m
        made = best_correction(before, positions_m, bench.sensor, bench.field, ratio, corrector)
        corrected, after = measured(_through(renderer, mask, made), index)
        predicted_rad, simulated_rad = made.mean_residual_rad, float(np.sqrt(np.nanmean(rms(after) ** 2)))
        most_rad = (1 + _AGREEMENT) * predicted_rad
        yield with_rms(f"{name}, predicted", at_m, without, predicted_rad)
        yield with_rms(f"{name}, simulated", at_m, corrected, simulated_rad, asked_rad=most_rad)


def _through(renderer: Renderer, mask: str, made: Correction) -> Image:
    """Irradiance (row, column), m^2, with the sample and a corrector."""
    scene, model = renderer.scene, renderer.model
    focal_length_m = scene.field.collimator_focal_length_m
    border_m = scene.simulation.border_lenslets * scene.sensor.lenslet_pitch_m
    x_m, y_m = (
        centered_steps(2 * (int((half_m + border_m) / _SPACING_M) + _MARGIN) + 1) * _SPACING_M
        for half_m in made.half_width_m
    )
    corrector = Layer(
        phase=PhaseScreen(made.phase(x_m, y_m[:, None]), _SPACING_M), distance_m=-made.ratio * focal_length_m
    )
    light = LayeredLight(
        [renderer.sample.layer(focal_length_m), corrector],
        scene.sensor,
        scene.field,
        pupil_half_width_m=(float(model.sample_x_m.max()), float(model.sample_y_m.max())),
    )
    return model.irradiance(renderer.points(mask), light.field(model.sample_x_m, model.sample_y_m))


CORRECTOR = Sweep(
    name="corrector",
    title="Best command of a corrector: residual over the field",
    axis="distance of the corrector from the lenslets (mm)",
    axis_per_si=1e3,
    measure=_measure,
)
