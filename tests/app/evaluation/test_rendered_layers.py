"""Layers found in frames that the forward model renders through two screens, and through ten."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from app.acquisition.devices import scene_of
from app.bench.config import load_bench
from reconstruction.layers.layer_search import LayerSearch, find_layers
from simulated_devices.optics.ray_map import RayMap
from simulated_devices.rendering import Renderer
from simulated_devices.sample import make_sample


def search(distances_m: tuple[float, ...], rms_rad: float, count: int) -> LayerSearch:
    """Layers found in a noise-free frame through screens of that strength."""
    bench = load_bench("small_demo")
    renderer, focal_length_m = Renderer(scene_of(bench)), bench.field.collimator_focal_length_m
    phases = []
    for seed, at_m in enumerate(distances_m, 3):
        screen = replace(bench.simulation.screen, distance_m=at_m, rms_rad=rms_rad, correlation_length_m=1e-3)
        sample = make_sample(replace(bench.simulation, seed=seed, screen=screen), bench.sensor, bench.field)
        place = RayMap.near_pupil(distance_m=at_m, collimator_focal_length_m=focal_length_m)
        phases.append(renderer.model.screen_phase(sample.screen, place))
    points = renderer.points("square")
    reference = renderer.reference("square")
    frame = renderer.model.irradiance(points, lambda x_m, y_m: np.sum([phase(x_m, y_m) for phase in phases], axis=0))
    reconstructor = bench.reconstructor(
        reference, lattice=bench.design_lattice(*reference.shape), dark=np.zeros_like(reference)
    )
    return find_layers(reconstructor.layers(reconstructor.register(frame)), count)


def test_ten_layers_are_not_a_single_layer() -> None:
    assert search(tuple(np.linspace(0.03, 0.3, 10)), 0.7, 1).verdict == "not a single layer"
