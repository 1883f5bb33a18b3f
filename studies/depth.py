"""Samples with depth, in noise: error, error bar and coverage behind one layer, two, and six."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from app.acquisition.devices import scene_of
from app.bench.config import Bench
from app.evaluation.frames import seeded, with_screen, with_source
from app.evaluation.mask_accuracy import calibration_of, mean_deviation_rad
from app.measurement.estimator import Estimator
from reconstruction.arrays import Floats, Image
from reconstruction.frame.noise import KnownNoise
from reconstruction.wavefront import Wavefront, mean_rms, without_piston
from simulated_devices.rendering import Renderer
from simulated_devices.sample import make_sample
from simulated_devices.settings import Mask
from studies.estimators import camera
from studies.layered_light import LayeredLight, layer_of
from studies.tables import Asked, Made, Row, steps

SAMPLES = {"one": (0.195,), "two": (0.25, 0.08), "six": (0.25, 0.21, 0.17, 0.13, 0.09, 0.05)}  # m from the lenslets
_MASKS: tuple[Mask, ...] = "checkerboard", "square"
_LENGTHS_M = 2e-3, 1.25e-3  # correlation length of smooth and rough layers
_LIGHT_E = math.inf, 1e4, 3e3, 1e3  # electrons in the reference's brightest pixel; without noise first
_ROUNDS = 0, 3  # of refinement
_REFERENCE_FRAMES, _REFERENCE = 20, 1 << 16  # of the reference, and the first index of their noise
_STREAM = 1 << 20  # of the random numbers between one screen's layers


def depth(asked: Asked, light_e: Sequence[float] = _LIGHT_E) -> Made:
    """Error, error bar and share of values within it, behind one, two and six layers, in noise; one pass, refined."""
    rows: list[Row] = []
    cases = list(product(_MASKS, SAMPLES, _LENGTHS_M, seeded(asked.bench, asked.seeds)))
    for mask, name, length_m, screen in steps(cases, "samples"):
        bench = with_source(with_screen(screen, correlation_length_m=length_m), mask=mask)
        images = layered_images(bench, SAMPLES[name])
        case = {"mask": mask, "layers": name, "length_mm": 1e3 * length_m}
        rows += [case | row for row in measured(bench, *images, light_e)]
    keys = [*case, "rounds", "light_e"]
    table = pd.DataFrame(rows).groupby(keys, sort=False).mean().reset_index()
    return table, _drawn(table)


def layered_images(bench: Bench, distances_m: Sequence[float]) -> tuple[Image, Image, Floats]:
    """Noise-free reference and frame, m^2, behind layers that are together as strong as the bench's screen, and truth.

    The truth (view_row, view_column, lenslet_row, lenslet_column) is the phase of the light at the lenslets, rad.
    """
    renderer, simulation = Renderer(scene_of(bench)), bench.simulation
    rms_rad = simulation.screen.rms_rad / math.sqrt(len(distances_m))
    layers = []
    for number, at_m in enumerate(distances_m):
        screen = replace(simulation.screen, distance_m=at_m, rms_rad=rms_rad)
        seed = simulation.seed + _STREAM * number
        layers.append(layer_of(make_sample(replace(simulation, seed=seed, screen=screen), bench.sensor, bench.field)))
    model = renderer.model
    reach_m = float(model.sample_x_m.max()), float(model.sample_y_m.max())
    light = LayeredLight(layers, bench.sensor, bench.field, pupil_half_width_m=reach_m)
    mask = simulation.source.mask
    frame = model.irradiance(renderer.points(mask), light.field(model.sample_x_m, model.sample_y_m))
    return renderer.reference(mask), frame, light.wavefront(bench.sensor, bench.field)


def measured(
    bench: Bench, reference: Image, frame: Image, truth: Floats, light_e: Sequence[float] = _LIGHT_E
) -> Iterator[Row]:
    """Yield error, error bar and coverage of a frame in several lights, with the sample found in it."""
    for peak_e in light_e:
        estimator, exposed = calibrated(bench, reference, peak_e)
        displacement = estimator.reconstructor.register(exposed(frame, 0))
        sample = estimator.reconstructor.find_sample(displacement)
        for rounds in _ROUNDS:
            wavefront = estimator.solve(displacement, sample=sample, rounds=rounds)[0]
            yield {"light_e": peak_e, "rounds": rounds, **next_to(truth, wavefront)}


def calibrated(bench: Bench, reference: Image, peak_e: float) -> tuple[Estimator, Callable[[Image, int], Image]]:
    """Prepare for a reference of 20 exposures, with `peak_e` electrons in its brightest pixel; inf: without noise.

    Also returns the exposure of an image, m^2, with the noise of some index.
    """
    em_camera, seed = camera(bench), bench.simulation.seed
    scale = np.float32((peak_e if math.isfinite(peak_e) else 1.0) / reference.max())

    def exposed(image: Image, index: int) -> Image:
        electrons = image * scale
        return em_camera.exposed(electrons, seed, index) if math.isfinite(peak_e) else em_camera.counts(electrons)

    if not math.isfinite(peak_e):
        return Estimator(calibration_of(bench, exposed(reference, 0))), exposed
    mean = np.mean([exposed(reference, _REFERENCE + draw) for draw in range(_REFERENCE_FRAMES)], axis=0)
    known = KnownNoise(em_camera.noise, _REFERENCE_FRAMES)
    return Estimator(replace(calibration_of(bench, mean), known=known)), exposed


def next_to(truth: Floats, wavefront: Wavefront) -> dict[str, float]:
    """Error and error bar, rad, and the share of lenslets and views within one bar."""
    valid, sigma = wavefront.displacement.valid, wavefront.sigma()
    error = without_piston(np.where(valid, wavefront.views - truth, np.nan))
    known = np.isfinite(error)
    return {
        "error_rad": mean_rms(error),
        "error_bar_rad": mean_deviation_rad(np.where(valid, sigma, np.nan)),
        "coverage": float(np.mean((np.abs(error) < sigma)[known])),
    }


def _drawn(table: pd.DataFrame) -> Figure:
    """Draw errors over their bars, a panel for each mask."""
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    panels = figure.subplots(1, len(_MASKS), sharex=True, sharey=True)
    for mask, panel in zip(_MASKS, panels, strict=True):
        for (name, rounds), points in table[table["mask"] == mask].groupby(["layers", "rounds"], sort=False):
            label = f"{name}{', refined' if rounds else ''}"
            panel.loglog(points["error_bar_rad"], points["error_rad"], "." if rounds else "o", label=label)
        ends = np.array(panel.get_xlim())
        panel.loglog(ends, ends, color="gray", linewidth=0.8)
        panel.set(title=mask, xlabel="error bar (rad)")
        panel.grid(visible=True, which="both", linewidth=0.3)
    panels[0].set_ylabel("error (rad)")
    panels[-1].legend(fontsize=8)
    return figure
