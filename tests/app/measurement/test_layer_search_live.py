"""The search for layers beside the live frames, in a process of its own: what it finds serves later frames."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from numpy.typing import NDArray
from support.estimators import estimator_with
from support.optics import SmallBench
from support.patience import HANG_S, wait_until
from test_background_estimator import bench_of, solver_of, until

from app.measurement.background_estimator import BackgroundEstimator, BackgroundEstimatorProcess, LiveEstimator, Solved
from app.measurement.background_estimator import _are_alike as are_alike
from app.measurement.estimator import Estimator
from app.measurement.measurement import Assumptions, RefinementState
from reconstruction.displacement import Displacement
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.reconstructor import Reconstructor
from reconstruction.wavefront import Wavefront


def behind_layer(bench: SmallBench, ratio: float) -> NDArray[np.float32]:
    """A frame behind one thin layer, met at s = u + ratio x."""
    half_width_m = bench.sensor.pupil_half_width_m[0]
    u, v = bench.samples()

    def phase(x_m: float, y_m: float) -> NDArray[np.float32]:
        s, t = (u + ratio * x_m) / half_width_m, (v + ratio * y_m) / half_width_m
        return (0.1 * (4 * s**2 - 3 * s * t + 2 * t**3 + 1.5 * s**4 - s**2 * t**3)).astype("f4")

    return bench.frame(phase)


def until_ratio(solver: LiveEstimator, displacement: Displacement, ratio: float) -> tuple[Wavefront, Assumptions]:
    """Solve a frame every 20 ms until one layer at about that ratio is assumed."""
    begin_s = time.monotonic()
    while True:
        wavefront, assumed = solver.solve(displacement, time.monotonic())
        sample, refinement, _ = assumed
        is_found = sample is not None and sample.ratios == pytest.approx((ratio,), abs=0.03)
        if is_found and refinement.stage in {"off", "applied"}:
            return wavefront, assumed
        assert time.monotonic() - begin_s < HANG_S
        time.sleep(0.02)


@pytest.fixture(scope="module")
def layered(paper_bench: SmallBench) -> Reconstructor:
    return paper_bench.reconstructor("cubic", pupil_modes=None, sample="automatic")


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("refine", [False, True])
def test_layers_found_in_the_background_serve_later_frames(
    paper_bench: SmallBench, layered: Reconstructor, *, refine: bool
) -> None:
    solver = solver_of(paper_bench, layered, refine=refine)
    try:
        displacement = layered.register(behind_layer(paper_bench, -0.8))
        first, assumed = solver.solve(displacement, 0.0)
        assert (assumed.sample, first.sample) == (None, FREE)
        assert solver.as_before(1.0).sample is None
        np.testing.assert_array_equal(first.views, layered.solve(displacement).views)
        wavefront, (sample, refinement, _) = until_ratio(solver, displacement, -0.8)
        assert sample is wavefront.sample is solver.as_before(1.0).sample
        again = layered.solve(displacement, bias=refinement.bias, sample=wavefront.sample)
        np.testing.assert_array_equal(wavefront.views, again.views)
        assert (refinement.bias is not None) == refine

        until_ratio(solver, layered.register(behind_layer(paper_bench, 0.5)), 0.5)  # searches go on
    finally:
        solver.close()


@pytest.mark.parametrize(
    ("found", "before", "alike"),
    [
        ((-0.8,), (-0.81,), True),
        ((-0.8,), (-0.82,), True),  # the errors of both together are 0.0071
        ((-0.8,), (-0.825,), False),
        ((-0.8,), (), False),
        ((), (), True),
        ((-0.8, 0.5), (-0.81, 0.51), True),
        ((-0.8, 0.5), (-0.81, 0.6), False),
    ],
)
def test_samples_within_their_errors_are_alike(
    found: tuple[float, ...], before: tuple[float, ...], *, alike: bool
) -> None:
    def sample(ratios: tuple[float, ...]) -> AssumedSample:
        return AssumedSample(ratios, np.diag(np.full(len(ratios), 0.005**2)))

    assert are_alike(sample(found), sample(before), 3.0) == alike


def test_a_sample_with_another_number_of_rivals_is_not_alike() -> None:
    """Else the error bars of live frames would leave out a rival that a later search finds."""
    alone, open_ = (AssumedSample((-0.8, -0.2), 1e-4 * np.eye(2), rivals) for rivals in ((), (-0.8, -0.5, -0.2)))
    assert not are_alike(open_, alone, 3.0)
    assert not are_alike(alone, open_, 3.0)
    assert are_alike(open_, AssumedSample((-0.8, -0.2), 1e-4 * np.eye(2), (-0.9, -0.5, -0.1)), 3.0)


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> list[BackgroundEstimatorProcess]:
    """Processes of background estimators; each solver starts one."""
    started = list[BackgroundEstimatorProcess]()

    def start(estimator: Estimator) -> BackgroundEstimatorProcess:
        started.append(BackgroundEstimatorProcess(estimator))
        return started[-1]

    monkeypatch.setattr("app.measurement.background_estimator.BackgroundEstimatorProcess", start)
    return started


@pytest.mark.slow
def test_process_finds_what_is_found_in_this_process(
    paper_bench: SmallBench, layered: Reconstructor, apart: list[BackgroundEstimatorProcess]
) -> None:
    estimator = estimator_with(layered, bench_of(paper_bench), paper_bench.reference)
    solver, displacement = LiveEstimator(estimator), layered.register(behind_layer(paper_bench, -0.8))
    try:
        _, (sample, refinement, _) = until_ratio(solver, displacement, -0.8)
        later = solver.solve(displacement, time.monotonic())[1].sample
    finally:
        solver.close()
    here = BackgroundEstimator(estimator)
    here.prepare()
    found = here.find(Solved(displacement, 0.0, Assumptions(None, RefinementState("preparing"))))
    assert found.sample is not None
    assert found.bias is not None
    assert later is sample is not None  # not a copy
    assert sample.ratios == pytest.approx(found.sample.ratios, rel=1e-6)
    assert refinement.bias == pytest.approx(found.bias.displacement, abs=1e-4)
    assert len(apart) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("apart")
def test_close_ends_the_process_amid_its_work(
    paper_bench: SmallBench, layered: Reconstructor, monkeypatch: pytest.MonkeyPatch
) -> None:
    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    solver, displacement = solver_of(paper_bench, layered), layered.register(behind_layer(paper_bench, -0.8))
    until_ratio(solver, displacement, -0.8)
    solver.solve(layered.register(behind_layer(paper_bench, 0.5)), 1.0)  # the bias of another wavefront is due
    solver.close()
    wait_until(lambda: not any(thread.name == "live-estimator" for thread in threading.enumerate()))
    assert not raised


@pytest.mark.slow
@pytest.mark.parametrize("has_found", [True, False])
def test_process_that_dies_is_reported_and_frames_go_on(
    paper_bench: SmallBench,
    layered: Reconstructor,
    apart: list[BackgroundEstimatorProcess],
    capsys: pytest.CaptureFixture[str],
    *,
    has_found: bool,
) -> None:
    solver = solver_of(paper_bench, layered)
    if has_found:
        until(solver, layered, paper_bench.reference, "applied")
    apart[0].process.kill()
    until(solver, layered, paper_bench.reference, "failed")
    _, (sample, state, _) = solver.solve(layered.register(paper_bench.reference), 0.0)
    assert sample is not None  # nobody waits for one
    assert state.problem == "the process that finds layers and corrections has ended: take the reference again (R)"
    solver.close()
    wait_until(lambda: not any(thread.name == "live-estimator" for thread in threading.enumerate()))
    assert capsys.readouterr().err == f"svwfs: {state.problem}\n"
