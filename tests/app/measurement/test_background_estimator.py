"""Live solves: a bias serves only near its wavefront, and rests; threads end."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from support.estimators import estimator_with
from support.optics import FIELD, SmallBench
from support.patience import HANG_S

from app.bench.config import Bench
from app.measurement.background_estimator import BackgroundEstimator, LiveEstimator, Solved
from app.measurement.measurement import Assumptions, RefinementState
from reconstruction.arrays import PointField
from reconstruction.displacement import Displacement
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.reconstructor import Reconstructor
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import rms


@pytest.fixture(scope="module")
def reconstructor(paper_bench: SmallBench) -> Reconstructor:
    return paper_bench.reconstructor("cubic", pupil_modes=None)


def bowl(bench: SmallBench, strength: float) -> NDArray[np.float32]:
    u, v = (axis / bench.sensor.pupil_half_width_m[0] for axis in bench.samples())
    half_m = FIELD.half_width_m
    return bench.frame(
        lambda x, y: (strength * (6 * (u**2 + v**2) + 4 * u**3 + 3 * x / half_m * u * v + y / half_m * u**2)).astype(
            "f4"
        )
    )


def bench_of(bench: SmallBench, *, refine: bool = True) -> Bench:
    reconstruction = ReconstructionSettings(refine=refine)
    return Bench(sensor=bench.sensor, field=bench.field, lattice=bench.lattice, reconstruction=reconstruction)


def solver_of(bench: SmallBench, reconstructor: Reconstructor, *, refine: bool = True) -> LiveEstimator:
    return LiveEstimator(estimator_with(reconstructor, bench_of(bench, refine=refine), bench.reference))


def until(solver: LiveEstimator, reconstructor: Reconstructor, frame: NDArray[np.float32], stage: str) -> float:
    """Refine a frame every 20 ms until the stage is reached; return the time (s)."""
    displacement, begin_s = reconstructor.register(frame), time.monotonic()
    while solver.solve(displacement, time.monotonic())[1].refinement.stage != stage:
        assert time.monotonic() - begin_s < HANG_S
        time.sleep(0.02)
    return time.monotonic() - begin_s


@pytest.mark.slow
@pytest.mark.long
def test_bias_applies_only_near_its_wavefront(paper_bench: SmallBench, reconstructor: Reconstructor) -> None:
    solver = solver_of(paper_bench, reconstructor)
    try:
        frame = bowl(paper_bench, 1.0)
        displacement = reconstructor.register(frame)
        once, (_, state, _) = solver.solve(displacement, 0.0)
        assert state.stage == "preparing"
        assert solver.as_before(1.0).refinement.bias is None
        np.testing.assert_array_equal(once.views, reconstructor.solve(displacement).views)
        until(solver, reconstructor, frame, "applied")
        time.sleep(1.0)  # some more rounds
        corrected, (_, state, _) = solver.solve(displacement, time.monotonic())
        assert state.age_s > 0
        assert state.moved_rad < 0.2
        now_s = time.monotonic()
        corrected, (_, state, _) = solver.solve(displacement, now_s)
        later = solver.as_before(now_s + 0.25).refinement  # for a skipped frame
        assert later.bias is state.bias is not None
        assert later.age_s == pytest.approx(state.age_s + 0.25)
        assert rms(corrected.views - once.views).mean() > 0.005

        gone = reconstructor.register(bowl(paper_bench, -1.0))
        found, (_, state, _) = solver.solve(gone, time.monotonic())
        assert state.stage == "moved"
        assert solver.as_before(time.monotonic()).refinement.bias is None
        assert state.moved_rad == pytest.approx(2 * rms(once.views).mean(), rel=0.1)
        np.testing.assert_array_equal(found.views, reconstructor.solve(gone).views)
        until(solver, reconstructor, bowl(paper_bench, -1.0), "applied")
    finally:
        solver.close()


@pytest.mark.slow
def test_nearly_flat_wavefront_keeps_bias(paper_bench: SmallBench, reconstructor: Reconstructor) -> None:
    solver, begin_s = solver_of(paper_bench, reconstructor), time.monotonic()
    until(solver, reconstructor, paper_bench.reference, "applied")
    end_s = time.monotonic()
    noise = np.random.default_rng(0).normal(0, 0.002 * paper_bench.reference.max(), paper_bench.frame_shape)
    displacement = reconstructor.register((paper_bench.reference + noise).astype(np.float32))
    state = solver.solve(displacement, end_s + 60.0)[1].refinement
    assert state.stage == "applied"
    assert 60.0 <= state.age_s <= 60.0 + end_s - begin_s
    solver.close()


def test_impossible_model_is_reported(
    paper_bench: SmallBench, reconstructor: Reconstructor, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ValueError("no such source")

    monkeypatch.setattr("app.measurement.estimator.BenchModel", fail)
    solver = solver_of(paper_bench, reconstructor)
    until(solver, reconstructor, paper_bench.reference, "failed")
    assert solver.solve(reconstructor.register(paper_bench.reference), 0.0)[1].refinement.problem == "no such source"


@pytest.mark.slow
def test_bias_that_worsens_the_misfit_is_rejected(
    paper_bench: SmallBench, reconstructor: Reconstructor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model that is nearly right for the first wavefront and wrong for its correction."""

    class Wild:
        sample_x_m, sample_y_m = paper_bench.model.sample_x_m, paper_bench.model.sample_y_m
        first_rad = math.nan

        def __init__(self, *_: object, threads: int) -> None:
            pass

        def image(self, field: PointField | None) -> NDArray[np.float32]:
            if field is None:
                return paper_bench.reference
            rms_rad = float(np.std(np.unwrap(np.unwrap(np.angle(field(0.0, 0.0)), axis=0), axis=1)))
            if math.isnan(self.first_rad):
                self.first_rad = rms_rad
            return bowl(paper_bench, 1.05 if abs(rms_rad / self.first_rad - 1) < 0.01 else 0.85)

    monkeypatch.setattr("app.measurement.estimator.BenchModel", Wild)
    solver = solver_of(paper_bench, reconstructor)
    try:
        frame = bowl(paper_bench, 1.0)
        until(solver, reconstructor, frame, "worse")
        displacement = reconstructor.register(frame)
        for _ in range(10):  # it stays rejected
            time.sleep(0.05)
            wavefront, (_, state, _) = solver.solve(displacement, time.monotonic())
            assert state.stage == "worse"
            assert state.bias is None
        np.testing.assert_array_equal(wavefront.views, reconstructor.solve(displacement).views)
        until(solver, reconstructor, bowl(paper_bench, -1.0), "moved")
    finally:
        solver.close()


def noisy(frame: NDArray[np.float32], random: np.random.Generator) -> NDArray[np.float32]:
    return frame + random.normal(0, 0.02 * frame.max(), frame.shape).astype(np.float32)


@pytest.mark.slow
def test_helpful_bias_in_noise_is_kept(paper_bench: SmallBench, reconstructor: Reconstructor) -> None:
    """Rounds at one strong wavefront, each frame with noise of its own."""
    here = BackgroundEstimator(estimator_with(reconstructor, bench_of(paper_bench), paper_bench.reference))
    here.prepare()
    random, state = np.random.default_rng(0), RefinementState("preparing")
    for _ in range(4):
        displacement = reconstructor.register(noisy(bowl(paper_bench, 1.0), random))
        found = here.find(Solved(displacement, 0.0, Assumptions(FREE, state)))
        assert found.is_helpful
        assert found.bias is not None
        state = RefinementState("applied", bias=found.bias.displacement)
    still = here.find(Solved(displacement, 1.0, Assumptions(FREE, state), is_still=True))
    assert still.bias is found.bias


@pytest.mark.slow
def test_correction_is_renewed_only_after_a_change(paper_bench: SmallBench, reconstructor: Reconstructor) -> None:
    solver, random = solver_of(paper_bench, reconstructor), np.random.default_rng(0)

    def age_s(strength: float) -> float:
        _, (_, state, _) = solver.solve(
            reconstructor.register(noisy(bowl(paper_bench, strength), random)), time.monotonic()
        )
        assert state.stage == "applied"
        time.sleep(0.05)
        return state.age_s

    try:
        until(solver, reconstructor, noisy(bowl(paper_bench, 1.0), random), "applied")
        assert np.all(np.diff([age_s(1.0) for _ in range(60)]) > 0)  # noise is no change
        before_s, deadline_s = age_s(1.0), time.monotonic() + HANG_S
        while age_s(1.2) > before_s:  # near enough for the old one to apply
            assert time.monotonic() < deadline_s
    finally:
        solver.close()


def solve_until(solver: LiveEstimator, displacement: Displacement, is_done: Callable[[], bool]) -> None:
    """Solve a frame every 10 ms until something is done."""
    deadline_s = time.monotonic() + HANG_S
    while not is_done():
        solver.solve(displacement, 0.0)
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def test_skipped_frame_has_the_bias_of_the_one_before_and_its_age(
    paper_bench: SmallBench, reconstructor: Reconstructor
) -> None:
    solver = solver_of(paper_bench, reconstructor, refine=False)
    displacement = reconstructor.register(paper_bench.reference)
    solver._newest = Solved(displacement, 5.0, Assumptions(FREE, RefinementState("applied", 2.0)))
    assert solver.as_before(5.25).refinement.age_s == pytest.approx(2.25)


def test_no_thread_without_layers_and_refinement(paper_bench: SmallBench, reconstructor: Reconstructor) -> None:
    before = set(threading.enumerate())  # those of other tests may be at their last finding
    solver = solver_of(paper_bench, reconstructor, refine=False)
    assert not solver.has_background_estimator
    displacement = reconstructor.register(bowl(paper_bench, 1.0))
    wavefront, assumed = solver.solve(displacement, 0.0)
    assert assumed == Assumptions()
    np.testing.assert_array_equal(wavefront.views, reconstructor.solve(displacement).views)
    assert not any(thread.name == "live-estimator" for thread in set(threading.enumerate()) - before)
