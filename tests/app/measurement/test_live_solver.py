"""Live refinement: the bias applies only near its wavefront, and the thread ends on request."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
import pytest
from app.measurement.live_refinement import LiveRefinement, RefinementState
from numpy.typing import NDArray
from support.optics import FIELD, SmallBench
from support.patience import HANG_S, wait_until

from app.bench.config import Bench
from reconstruction.pipeline import Reconstructor
from reconstruction.refinement import PointPhase
from reconstruction.wavefront import rms


@pytest.fixture(scope="module")
def reconstructor(small_bench: SmallBench) -> Reconstructor:
    return small_bench.reconstructor("cubic", pupil_modes=None)


def bowl(bench: SmallBench, strength: float) -> NDArray[np.float32]:
    u, v = (axis / bench.sensor.pupil_half_width_m[0] for axis in bench.samples())
    half_m = FIELD.half_width_m
    return bench.frame(
        lambda x, y: (strength * (6 * (u**2 + v**2) + 4 * u**3 + 3 * x / half_m * u * v + y / half_m * u**2)).astype(
            "f4"
        )
    )


def bench_of(small_bench: SmallBench) -> Bench:
    return Bench(sensor=small_bench.sensor, field=FIELD, lattice=small_bench.lattice)


def until(refinement: LiveRefinement, reconstructor: Reconstructor, frame: NDArray[np.float32], stage: str) -> float:
    """Refine a frame every 20 ms until the stage is reached; return the time (s)."""
    displacement, begin_s = reconstructor.register(frame), time.monotonic()
    while refinement.refine(displacement, time.monotonic())[1].stage != stage:
        assert time.monotonic() - begin_s < HANG_S
        time.sleep(0.02)
    return time.monotonic() - begin_s


def test_bias_applies_only_near_its_wavefront(small_bench: SmallBench, reconstructor: Reconstructor) -> None:
    refinement = LiveRefinement(bench_of(small_bench), reconstructor)
    try:
        frame = bowl(small_bench, 1.0)
        displacement = reconstructor.register(frame)
        once, state = refinement.refine(displacement, 0.0)
        assert state.stage == "preparing"
        assert refinement.as_before(1.0).bias is None
        np.testing.assert_array_equal(once.views, reconstructor.solve(displacement).views)
        until(refinement, reconstructor, frame, "applied")
        time.sleep(1.0)  # some more rounds
        corrected, state = refinement.refine(displacement, time.monotonic())
        assert state.age_s > 0
        assert state.moved_rad < 0.2
        now_s = time.monotonic()
        corrected, state = refinement.refine(displacement, now_s)
        later = refinement.as_before(now_s + 0.25)  # for a skipped frame
        assert later.bias is state.bias is not None
        assert later.age_s == pytest.approx(state.age_s + 0.25)
        assert rms(corrected.views - once.views).mean() > 0.005

        gone = reconstructor.register(bowl(small_bench, -1.0))
        found, state = refinement.refine(gone, time.monotonic())
        assert state.stage == "moved"
        assert refinement.as_before(time.monotonic()).bias is None
        assert state.moved_rad == pytest.approx(2 * rms(once.views).mean(), rel=0.1)
        np.testing.assert_array_equal(found.views, reconstructor.solve(gone).views)
        until(refinement, reconstructor, bowl(small_bench, -1.0), "applied")
    finally:
        refinement.close()


def test_nearly_flat_wavefront_keeps_bias(small_bench: SmallBench, reconstructor: Reconstructor) -> None:
    refinement = LiveRefinement(bench_of(small_bench), reconstructor)
    until(refinement, reconstructor, small_bench.reference, "applied")
    noise = np.random.default_rng(0).normal(0, 0.002 * small_bench.reference.max(), small_bench.frame_shape)
    displacement = reconstructor.register((small_bench.reference + noise).astype(np.float32))
    assert refinement.refine(displacement, 1.0)[1].stage == "applied"
    refinement.close()


def test_refinement_thread_ends(small_bench: SmallBench, reconstructor: Reconstructor) -> None:
    refinement = LiveRefinement(bench_of(small_bench), reconstructor)
    until(refinement, reconstructor, small_bench.reference, "applied")
    refinement.close()
    wait_until(lambda: not any(thread.name == "refinement" for thread in threading.enumerate()))


@pytest.mark.parametrize("closes", [True, False])
def test_round_cut_short_by_exit_is_no_error(
    small_bench: SmallBench, reconstructor: Reconstructor, monkeypatch: pytest.MonkeyPatch, *, closes: bool
) -> None:
    def cut_short(*_: object) -> None:
        if closes:
            refinement.close()
        raise RuntimeError("cannot schedule new futures after shutdown")

    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    monkeypatch.setattr("app.measurement.live_refinement.Refinement.bias", cut_short)
    refinement = LiveRefinement(bench_of(small_bench), reconstructor)
    refinement.refine(reconstructor.register(small_bench.reference), 0.0)
    wait_until(lambda: not any(thread.name == "refinement" for thread in threading.enumerate()))
    assert len(raised) == (0 if closes else 1)


def test_impossible_model_is_reported(
    small_bench: SmallBench, reconstructor: Reconstructor, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("no such source")

    monkeypatch.setattr("app.measurement.live_refinement.BenchModel", fail)
    refinement = LiveRefinement(bench_of(small_bench), reconstructor)
    until(refinement, reconstructor, small_bench.reference, "failed")
    assert refinement.refine(reconstructor.register(small_bench.reference), 0.0)[1].problem == "no such source"


def test_refinement_is_off_by_default() -> None:
    state = RefinementState()
    assert state.stage == "off"
    assert math.isnan(state.age_s)


def test_bias_that_worsens_the_misfit_is_rejected(
    small_bench: SmallBench, reconstructor: Reconstructor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model that is nearly right for the first wavefront and wrong for its correction."""

    class Wild:
        sample_x_m, sample_y_m = small_bench.model.sample_x_m, small_bench.model.sample_y_m
        first_rad = math.nan

        def __init__(self, *_: object) -> None:
            pass

        def image(self, phase: PointPhase | None) -> NDArray[np.float32]:
            if phase is None:
                return small_bench.reference
            rms_rad = float(np.std(phase(0.0, 0.0)))
            if math.isnan(self.first_rad):
                self.first_rad = rms_rad
            return bowl(small_bench, 1.05 if abs(rms_rad / self.first_rad - 1) < 0.01 else 0.85)

    monkeypatch.setattr("app.measurement.live_refinement.BenchModel", Wild)
    refinement = LiveRefinement(bench_of(small_bench), reconstructor)
    try:
        frame = bowl(small_bench, 1.0)
        until(refinement, reconstructor, frame, "worse")
        displacement = reconstructor.register(frame)
        for _ in range(10):  # it stays rejected
            time.sleep(0.05)
            wavefront, state = refinement.refine(displacement, time.monotonic())
            assert state.stage == "worse"
            assert state.bias is None
        np.testing.assert_array_equal(wavefront.views, reconstructor.solve(displacement).views)
        until(refinement, reconstructor, bowl(small_bench, -1.0), "moved")
    finally:
        refinement.close()


def test_helpful_bias_in_noise_is_kept(small_bench: SmallBench, reconstructor: Reconstructor) -> None:
    """Rounds at one strong wavefront, each frame with noise of its own."""
    refinement = LiveRefinement(bench_of(small_bench), reconstructor)
    random, clean = np.random.default_rng(0), bowl(small_bench, 1.0)
    try:
        until(refinement, reconstructor, clean, "applied")
        ages_s: list[float] = []
        deadline_s = time.monotonic() + HANG_S
        while len(ages_s) < 40 or np.sum(np.diff(ages_s) < 0) < 2:  # rounds that were judged
            assert time.monotonic() < deadline_s
            frame = clean + random.normal(0, 0.02 * clean.max(), clean.shape).astype(np.float32)
            _, state = refinement.refine(reconstructor.register(frame), time.monotonic())
            assert state.stage == "applied"
            ages_s.append(state.age_s)
            time.sleep(0.05)
    finally:
        refinement.close()
