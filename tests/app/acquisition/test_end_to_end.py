"""Acquisition at the camera's full size on the simulated bench: no loss, and true wavefronts."""

from __future__ import annotations

from contextlib import closing
from functools import cache

import numpy as np
import pytest
from support.patience import HANG_S, wait_until
from support.simulated_scene import current_state, states_rendered

from app.acquisition.devices import open_devices, simulated_bench
from app.acquisition.instrument import Instrument
from app.acquisition.start_up import knows_sample, start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.evaluation.frames import NoiseFreeFrames
from app.measurement.measurement import Measurement
from reconstruction.wavefront import Wavefront, rms
from simulated_devices.camera import SimulatedCamera

FRAMES = 32  # at least


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("no_hurry")
def test_live_wavefronts_match_truth_without_loss() -> None:
    coarse = "simulation.object_samples=13", "simulation.pupil_samples=10"
    bench = load_bench("live_demo", ("camera.exposure_s=0.1", "camera.em_gain=1.0", *coarse))
    with closing(simulated_bench(bench, lambda _: None)) as ahead:  # render before the acquisition needs the processor
        wait_until(lambda: current_state(ahead) >= 0 and states_rendered(ahead) > 1)
    measurements: list[Measurement] = []
    acquisition = Acquisition(bench, open_devices, sinks=(measurements.append,))

    acquisition.start()
    try:
        for step in start_up(acquisition, 5):
            step.result(HANG_S)
        wait_until(lambda: knows_sample(acquisition))
        begin = acquisition.counts.acquired
        wait_until(lambda: acquisition.counts.acquired >= begin + FRAMES)
        newest = acquisition.commands.submit(
            lambda instrument: _with_states(instrument, measurements[-FRAMES:])
        ).result(HANG_S)
    finally:
        acquisition.close()
    assert acquisition.failure == ""
    assert len({state for _, state in newest}) > 1  # the screen has drifted
    counts = measurements[-1].counts
    assert counts.lost == 0
    assert counts.reconstructed == counts.acquired == len(measurements)
    truth = cache(NoiseFreeFrames(bench).renderer.truth_wavefront)
    residual = [rms(wavefront.views - truth(state)).mean() for wavefront, state in newest]
    assert all(wavefront.sample.ratios for wavefront, _ in newest)  # else the square does not show its wavefront
    assert all(
        np.all(measurement.wavefront.displacement.valid) for measurement in measurements if measurement.wavefront
    )
    assert np.mean(residual) < 0.07


def _with_states(instrument: Instrument, measurements: list[Measurement]) -> list[tuple[Wavefront, int]]:
    """Wavefront of each measurement, and the state of the sample."""
    camera = instrument.devices.camera
    assert isinstance(camera, SimulatedCamera)
    states = [(measurement.wavefront, camera.state_of_frame(measurement.frame.index)) for measurement in measurements]
    camera.stop()  # a last frame might be taken in the dark while the acquisition closes
    return [(wavefront, state) for wavefront, state in states if wavefront is not None and state is not None]
