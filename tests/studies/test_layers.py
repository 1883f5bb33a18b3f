"""Correctors as predicted from one frame, against light through sample and corrector; distances of a layer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from app.bench.config import load_bench
from app.evaluation.frames import simulate
from app.measurement.bench_reconstructor import BenchReconstructor
from reconstruction.arrays import Floats
from reconstruction.geometry import centered_steps
from reconstruction.layers.corrector import Correction, Corrector, best_correction, field_positions_m
from reconstruction.wavefront import rms
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.sample import PlacedScreen, make_sample
from studies.layered_light import LayeredLight
from studies.layers import distances, predicted_and_simulated
from studies.tables import Asked

LAYER_M, F1_M = 0.195, 0.2
BENCH = load_bench("small_demo", ("simulation.source.mask='checkerboard'",))


@pytest.mark.slow
def test_predicted_residuals_agree_with_simulated_ones() -> None:
    cases = [(Corrector("zernike", 10), share * LAYER_M) for share in (0.0, 1.0)]
    found = list(predicted_and_simulated(BENCH, cases))
    predicted, simulated = ([each["rms_rad"] for each in found[start::2]] for start in (0, 1))
    assert [each["at"] for each in found[::2]] == [at_m * 1e3 for _, at_m in cases]
    assert simulated == pytest.approx(predicted, rel=0.1)
    assert simulated[1] < 0.4 * simulated[0]


@pytest.mark.slow
def test_distances_of_a_layer_are_found_within_their_error_bars() -> None:
    table, _ = distances(Asked(BENCH), (LAYER_M,))
    found = table.set_index("case")
    assert list(found.index) == ["checkerboard, 195 mm", "square, 195 mm"]
    assert (found["error (%), worst"] < 20).all()
    assert (found["error over its bar, worst"] < 4).all()


@pytest.fixture(scope="module")
def correction() -> Correction:
    """Best command in the layer's place, from a noisy frame."""
    images = simulate(BENCH)
    wavefront = BenchReconstructor(BENCH, images.reference, dark=images.dark)(images.frames[0])
    positions_m = field_positions_m(BENCH.field)
    before = np.array([wavefront.at(x_m, y_m) for x_m, y_m in positions_m])
    shapes = Corrector("legendre", 66)
    return best_correction(
        before, positions_m=positions_m, sensor=BENCH.sensor, field=BENCH.field, ratio=-LAYER_M / F1_M, corrector=shapes
    )


def left_rad(made: Correction, change: Callable[[Floats], Floats], distance_m: float = LAYER_M) -> float:
    """True RMS of the views after sample and corrector, light propagated between them."""
    spacing_m = 25e-6
    count = 2 * int(float(made.half_width_m[0]) / spacing_m) + 1
    along_m = centered_steps(count) * spacing_m
    command = PhaseScreen(change(made.phase(along_m, along_m[:, None])), spacing_m)
    sample = make_sample(BENCH.simulation, BENCH.sensor, BENCH.field).layer()
    layers = [sample, PlacedScreen(phase=command, distance_m=distance_m)]
    light = LayeredLight(layers, BENCH.sensor, BENCH.field, pupil_half_width_m=BENCH.sensor.pupil_half_width_m)
    return float(np.mean(rms(light.wavefront(BENCH.sensor, BENCH.field))))


@pytest.mark.slow
@pytest.mark.long
def test_command_cancels_the_wavefront_at_all_field_positions(correction: Correction) -> None:
    uncorrected_rad = left_rad(correction, np.zeros_like)
    assert left_rad(correction, lambda phase: phase) < 0.05 * uncorrected_rad
    wrong = {
        "sign": left_rad(correction, np.negative),
        "mirrored along x": left_rad(correction, lambda phase: phase[:, ::-1]),
        "mirrored along y": left_rad(correction, lambda phase: phase[::-1]),
        "transposed": left_rad(correction, np.transpose),
        "behind the lenslets": left_rad(correction, lambda phase: phase, -LAYER_M),
    }
    assert min(wrong.values()) > 0.3 * uncorrected_rad, wrong
