"""Calibrations and measurements reproduce wavefronts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.patience import HANG_S, wait_until

from app.acquisition.devices import open_devices
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.measurement.calibration import Calibration
from app.measurement.measurement import SKIPPED, Measurement
from reconstruction.reconstructor import Reconstructor
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.solve.modal import ModalSolution


def measured(toml: Path, enough: Callable[[list[Measurement]], bool], *settings: str) -> list[Measurement]:
    """Run the small bench until the measurements are `enough`."""
    measurements: list[Measurement] = []
    acquisition = Acquisition(load_bench(toml, settings), open_devices, sinks=(measurements.append,))
    acquisition.start()
    try:
        for step in start_up(acquisition, 4):
            step.result(HANG_S)
        wait_until(lambda: enough(measurements))
        # same settings, but another calibration
        acquisition.commands.submit(lambda instrument: instrument.change_settings(())).result(HANG_S)
        before = len(measurements)
        wait_until(lambda: sum(not one.problem for one in measurements[before:]) >= 3)
        return list(measurements)  # closing switches the light off beside the worker: one more frame may be dark
    finally:
        acquisition.close()


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("refine", ["false", "true"])
@pytest.mark.parametrize("lattice", ["lattice.center_x_px=121.3", "found"])
def test_calibration_reproduces_frames(small_toml: Path, tmp_path: Path, refine: str, lattice: str) -> None:
    toml = tmp_path / "bench.toml"
    text = small_toml.read_text()
    toml.write_text(
        text if lattice != "found" else text.replace(text[text.index("[lattice]") : text.index("[field]")], "")
    )

    def is_enough(measurements: list[Measurement]) -> bool:
        made = [measurement for measurement in measurements if measurement.wavefront is not None]
        return len(made) > 8 and (refine == "false" or made[-1].assumed.refinement.stage == "applied")

    measurements = measured(toml, is_enough, f"reconstruction.refine={refine}")
    reconstructors: dict[Calibration, Reconstructor] = {}
    registered = None
    with one_blas_thread():
        for measurement in measurements:
            calibration = measurement.calibration
            assert calibration is not None
            if measurement.problem == SKIPPED:  # has no result to reproduce
                continue
            if calibration not in reconstructors:
                reconstructors[calibration], registered = calibration.reconstructor(), None
            again = reconstructors[calibration].register(measurement.frame.pixels, start=registered)
            registered = measurement.registered
            assert registered is not None
            np.testing.assert_array_equal(again.coefficients, registered.coefficients)
            solved = reconstructors[calibration].solve(again, bias=measurement.assumed.refinement.bias)
            assert measurement.wavefront is not None
            np.testing.assert_array_equal(solved.views, measurement.wavefront.views)
            assert isinstance(solved.solution, ModalSolution)
            assert isinstance(measurement.wavefront.solution, ModalSolution)
            np.testing.assert_array_equal(solved.solution.coefficients, measurement.wavefront.solution.coefficients)
    assert len(reconstructors) == 2
    assert any(measurement.assumed.refinement.bias is not None for measurement in measurements) == (refine == "true")
