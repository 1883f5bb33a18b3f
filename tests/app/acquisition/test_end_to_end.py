"""Acquisition at the camera's full size on the simulated bench: no loss, and true wavefronts."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from support.patience import HANG_S, wait_until

from app.acquisition.devices import open_devices, simulated_bench
from app.acquisition.instrument import Instrument
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition, Measurement
from app.bench.config import load_bench
from app.evaluation.noise_free import NoiseFreeFrames
from reconstruction.wavefront import rms
from simulated_devices.camera import SimulatedCamera

FRAMES = 32  # at least


@pytest.mark.usefixtures("no_hurry")
def test_live_wavefronts_match_truth_without_loss() -> None:
    bench = load_bench("live_demo", ("camera.exposure_s=0.1", "camera.em_gain=1.0"))
    with closing(simulated_bench(bench, lambda _: None)) as ahead:  # render before the acquisition needs the processor
        wait_until(lambda: ahead.current_state(ahead.clock.now()) >= 0 and ahead.states_rendered > 1)
    measurements: list[Measurement] = []
    acquisition = Acquisition(bench, open_devices, sinks=(measurements.append,))

    acquisition.start()
    try:
        for step in start_up(acquisition, 5):
            step.result(HANG_S)
        wait_until(lambda: acquisition.counts.acquired >= FRAMES)
        seen = acquisition.submit(lambda instrument: _states(instrument, measurements)).result(HANG_S)
    finally:
        acquisition.close()
    assert acquisition.failure == ""
    assert len(set(seen)) > 1  # the screen has drifted
    counts = measurements[-1].counts
    assert counts.lost == 0
    assert counts.reconstructed == counts.acquired == len(measurements)
    renderer = NoiseFreeFrames(bench).renderer
    truths = {state: renderer.truth_wavefront(state) for state in set(seen)}
    residual = [
        rms(measurement.wavefront.views - truths[state]).mean()
        for measurement, state in zip(measurements, seen, strict=False)
        if measurement.wavefront is not None
    ]
    assert all(
        np.all(measurement.wavefront.displacement.valid) for measurement in measurements if measurement.wavefront
    )
    assert np.mean(residual) < 0.07


def _states(instrument: Instrument, measurements: list[Measurement]) -> list[int]:
    """State of the sample in every measured frame; these are all, as the camera is stopped."""
    camera = instrument.devices.camera
    assert isinstance(camera, SimulatedCamera)
    states = [camera.state_of_frame(measurement.frame.index) for measurement in measurements]
    camera.stop()  # a last frame might be taken in the dark while the acquisition closes
    return [state for state in states if state is not None]
