"""Layers found in frames that the forward model renders through two screens, and through ten."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.acquisition.devices import scene_of
from app.bench.config import load_bench
from app.measurement.calibration import Calibration
from reconstruction.arrays import Floats
from reconstruction.layers.layer_search import search_layers
from reconstruction.layers.layer_solver import FrameEquations
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.rendering import Renderer
from simulated_devices.sample import make_sample
from studies.layered_light import LayeredLight, layer_of


def rendered(preset: str, distances_m: tuple[float, ...], **settings: Any) -> tuple[FrameEquations, list[PhaseScreen]]:
    """Displacements of a noise-free frame through screens of such settings, and the screens.

    Propagation is neglected: that of ten layers takes minutes.
    """
    bench = load_bench(preset, ("field.neglect_propagation=true",))
    renderer = Renderer(scene_of(bench))
    layers, screens = [], []
    for seed, at_m in enumerate(distances_m, 3):
        screen = replace(bench.simulation.screen, distance_m=at_m, **settings)
        sample = make_sample(replace(bench.simulation, seed=seed, screen=screen), bench.sensor, bench.field)
        layers.append(layer_of(sample))
        screens.append(sample.screen)
    points, model = renderer.points("square"), renderer.model
    reference = renderer.reference("square")
    reach_m = float(model.sample_x_m.max()), float(model.sample_y_m.max())
    light = LayeredLight(layers, bench.sensor, bench.field, pupil_half_width_m=reach_m)
    frame = model.irradiance(points, light.field(model.sample_x_m, model.sample_y_m))
    lattice, dark = bench.design_lattice(*reference.shape), np.zeros_like(reference)
    reconstructor = Calibration.of_images(bench, reference, dark=dark, lattice=lattice).reconstructor()
    return reconstructor.layers(reconstructor.register(frame)), screens


def slopes(phase_rad: Floats) -> Floats:
    """Slopes (y, x, xy) about their mean: two layers share tip and tilt in any way."""
    along_y, along_x = np.gradient(phase_rad)
    found = np.stack([along_x, along_y], axis=-1)
    return np.asarray(found - found.mean(axis=(0, 1)))


@pytest.mark.slow
@pytest.mark.long
def test_ten_layers_are_not_a_single_layer() -> None:
    displacements, _ = rendered("small_demo", tuple(np.linspace(0.03, 0.3, 10)), rms_rad=0.7, correlation_length_m=1e-3)
    assert search_layers(displacements).verdict == "not a single layer"


@pytest.mark.slow
@pytest.mark.long
def test_two_layers_at_known_distances_are_told_apart() -> None:
    distances_m = (0.1, 0.2)
    displacements, screens = rendered("paper_simulation", distances_m, rms_rad=3.0)
    found = search_layers(displacements, 2, at=tuple(-at_m / 0.2 for at_m in distances_m)).fit.layers
    for layer, screen in zip(found, screens[::-1], strict=True):  # the farthest first
        x_m, y_m = (np.linspace(-0.85 * half_m, 0.85 * half_m, 61) for half_m in layer.half_width_m)
        true = slopes(screen.at(x_m, y_m[:, None]))
        error = slopes(layer.phase(x_m, y_m[:, None])) - true
        assert np.linalg.norm(error) < 0.08 * np.linalg.norm(true)
