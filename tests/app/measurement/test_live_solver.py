"""Live solves: layers found in the background serve later frames, a bias only near its wavefront; threads end."""

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
from support.patience import HANG_S, wait_until

from app.bench.config import Bench
from app.measurement.estimator import Estimator
from app.measurement.live_solver import Finder, FinderProcess, Found, LiveSolver, Solved
from app.measurement.live_solver import _are_alike as are_alike
from app.measurement.measurement import Assumptions, RefinementState
from reconstruction.arrays import PointField
from reconstruction.displacement import Displacement
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.pipeline import Reconstructor
from reconstruction.refinement import Bias, Refinement
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront, rms


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


def solver_of(bench: SmallBench, reconstructor: Reconstructor, *, refine: bool = True) -> LiveSolver:
    return LiveSolver(estimator_with(reconstructor, bench_of(bench, refine=refine), bench.reference))


def until(solver: LiveSolver, reconstructor: Reconstructor, frame: NDArray[np.float32], stage: str) -> float:
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
        once, (_, state) = solver.solve(displacement, 0.0)
        assert state.stage == "preparing"
        assert solver.as_before(1.0).refinement.bias is None
        np.testing.assert_array_equal(once.views, reconstructor.solve(displacement).views)
        until(solver, reconstructor, frame, "applied")
        time.sleep(1.0)  # some more rounds
        corrected, (_, state) = solver.solve(displacement, time.monotonic())
        assert state.age_s > 0
        assert state.moved_rad < 0.2
        now_s = time.monotonic()
        corrected, (_, state) = solver.solve(displacement, now_s)
        later = solver.as_before(now_s + 0.25).refinement  # for a skipped frame
        assert later.bias is state.bias is not None
        assert later.age_s == pytest.approx(state.age_s + 0.25)
        assert rms(corrected.views - once.views).mean() > 0.005

        gone = reconstructor.register(bowl(paper_bench, -1.0))
        found, (_, state) = solver.solve(gone, time.monotonic())
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


@pytest.mark.slow
def test_refinement_thread_ends(paper_bench: SmallBench, reconstructor: Reconstructor) -> None:
    solver = solver_of(paper_bench, reconstructor)
    until(solver, reconstructor, paper_bench.reference, "applied")
    solver.close()
    wait_until(lambda: not any(thread.name == "live-solver" for thread in threading.enumerate()))


@pytest.mark.parametrize("closes", [True, False])
def test_round_cut_short_by_exit_is_no_error(
    paper_bench: SmallBench, reconstructor: Reconstructor, monkeypatch: pytest.MonkeyPatch, *, closes: bool
) -> None:
    def cut_short(*_: object) -> None:
        if closes:
            solver.close()
        raise RuntimeError("cannot schedule new futures after shutdown")

    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    monkeypatch.setattr("app.measurement.estimator.Refinement.bias", cut_short)
    solver = solver_of(paper_bench, reconstructor)
    solver.solve(reconstructor.register(paper_bench.reference), 0.0)
    wait_until(lambda: not any(thread.name == "live-solver" for thread in threading.enumerate()))
    assert len(raised) == (0 if closes else 1)


def test_impossible_model_is_reported(
    paper_bench: SmallBench, reconstructor: Reconstructor, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ValueError("no such source")

    monkeypatch.setattr("app.measurement.estimator.BenchModel", fail)
    solver = solver_of(paper_bench, reconstructor)
    until(solver, reconstructor, paper_bench.reference, "failed")
    assert solver.solve(reconstructor.register(paper_bench.reference), 0.0)[1].refinement.problem == "no such source"


def test_refinement_is_off_by_default() -> None:
    state = RefinementState()
    assert state.stage == "off"
    assert math.isnan(state.age_s)


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
            wavefront, (_, state) = solver.solve(displacement, time.monotonic())
            assert state.stage == "worse"
            assert state.bias is None
        np.testing.assert_array_equal(wavefront.views, reconstructor.solve(displacement).views)
        until(solver, reconstructor, bowl(paper_bench, -1.0), "moved")
    finally:
        solver.close()


@pytest.mark.slow
def test_helpful_bias_in_noise_is_kept(paper_bench: SmallBench, reconstructor: Reconstructor) -> None:
    """Rounds at one strong wavefront, each frame with noise of its own."""
    solver = solver_of(paper_bench, reconstructor)
    random, clean = np.random.default_rng(0), bowl(paper_bench, 1.0)

    def noisy() -> NDArray[np.float32]:
        return clean + random.normal(0, 0.02 * clean.max(), clean.shape).astype(np.float32)

    try:
        until(solver, reconstructor, noisy(), "applied")
        ages_s: list[float] = []
        deadline_s = time.monotonic() + HANG_S
        while len(ages_s) < 40 or np.sum(np.diff(ages_s) < 0) < 2:  # rounds that were judged
            assert time.monotonic() < deadline_s
            _, (_, state) = solver.solve(reconstructor.register(noisy()), time.monotonic())
            assert state.stage == "applied"
            ages_s.append(state.age_s)
            time.sleep(0.05)
    finally:
        solver.close()


def behind_layer(bench: SmallBench, ratio: float) -> NDArray[np.float32]:
    """A frame behind one thin layer, met at s = u + ratio x."""
    half_width_m = bench.sensor.pupil_half_width_m[0]
    u, v = bench.samples()

    def phase(x_m: float, y_m: float) -> NDArray[np.float32]:
        s, t = (u + ratio * x_m) / half_width_m, (v + ratio * y_m) / half_width_m
        return (0.1 * (4 * s**2 - 3 * s * t + 2 * t**3 + 1.5 * s**4 - s**2 * t**3)).astype("f4")

    return bench.frame(phase)


def until_ratio(solver: LiveSolver, displacement: Displacement, ratio: float) -> tuple[Wavefront, Assumptions]:
    """Solve a frame every 20 ms until one layer at about that ratio is assumed."""
    begin_s = time.monotonic()
    while True:
        wavefront, assumed = solver.solve(displacement, time.monotonic())
        sample, refinement = assumed
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
        wavefront, (sample, refinement) = until_ratio(solver, displacement, -0.8)
        assert sample is wavefront.sample is solver.as_before(1.0).sample
        again = layered.solve(displacement, bias=refinement.bias, sample=wavefront.sample)
        np.testing.assert_array_equal(wavefront.views, again.views)
        assert (refinement.bias is not None) == refine

        until_ratio(solver, layered.register(behind_layer(paper_bench, 0.5)), 0.5)  # searches go on
    finally:
        solver.close()


@pytest.mark.slow
def test_bias_is_found_with_the_sample_of_the_frames(
    paper_bench: SmallBench, layered: Reconstructor, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[AssumedSample, Bias]] = []
    original = Refinement.bias

    def noted(self: Refinement, wavefront: Wavefront) -> Bias:
        bias = original(self, wavefront)
        seen.append((wavefront.sample, bias))
        return bias

    monkeypatch.setattr("app.measurement.estimator.Refinement.bias", noted)
    solver = solver_of(paper_bench, layered)
    try:
        displacement = layered.register(behind_layer(paper_bench, -0.8))
        applied: list[Assumptions] = []
        deadline_s = time.monotonic() + HANG_S
        while len({id(each.sample) for each in applied}) < 2:  # two searches
            assert time.monotonic() < deadline_s
            _, assumed = solver.solve(displacement, time.monotonic())
            applied += [assumed] if assumed.refinement.bias is not None else []
            time.sleep(0.02)
        for sample, refinement in applied:
            assert any(sample is of and refinement.bias is bias.displacement for of, bias in seen)
    finally:
        solver.close()


def test_search_that_finds_the_same_again_rests_for_longer(
    paper_bench: SmallBench, layered: Reconstructor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes a processor from the frames."""
    took_s, began_s = 0.05, list[float]()

    def search(_: Reconstructor, __: Displacement) -> AssumedSample:
        began_s.append(time.monotonic())
        time.sleep(took_s)
        return AssumedSample((-0.8 + 0.004 * (len(began_s) % 2),), np.array([[0.002**2]]))

    asked = list[Solved]()
    find = Finder.find

    def noted(finder: Finder, newest: Solved) -> Found:
        asked.append(newest)
        return find(finder, newest)

    monkeypatch.setattr(Reconstructor, "find_sample", search)
    monkeypatch.setattr(Finder, "find", noted)
    solver = solver_of(paper_bench, layered, refine=False)
    displacement = layered.register(behind_layer(paper_bench, -0.8))
    try:
        solve_until(solver, displacement, lambda: len(began_s) == 3)
    finally:
        solver.close()
    assert len(asked) == 3  # not for every frame: each goes to another process
    assert began_s[2] - began_s[1] >= 10 * took_s


@pytest.mark.slow
@pytest.mark.parametrize(("strength", "rests"), [(1.0, True), (-1.0, False)], ids=["applied", "moved"])
def test_refinement_rests_unless_frames_lack_a_correction(
    paper_bench: SmallBench, reconstructor: Reconstructor, *, strength: float, rests: bool
) -> None:
    solver, waits_s = solver_of(paper_bench, reconstructor), list[float]()
    wait = solver._closing.wait

    def noted(timeout_s: float) -> bool:
        waits_s.append(timeout_s)
        return wait(timeout_s)

    try:
        first = reconstructor.register(bowl(paper_bench, 1.0))
        solve_until(solver, first, lambda: solver.solve(first, 0.0)[1].refinement.stage == "applied")
        solver.solve(reconstructor.register(bowl(paper_bench, strength)), 0.0)
        solver._closing.wait = noted  # type: ignore[method-assign,assignment] # sees the rests
        solver._rest(0.1)
    finally:
        solver.close()
    assert bool(waits_s) == rests


def solve_until(solver: LiveSolver, displacement: Displacement, is_done: Callable[[], bool]) -> None:
    """Solve a frame every 10 ms until something is done."""
    deadline_s = time.monotonic() + HANG_S
    while not is_done():
        solver.solve(displacement, 0.0)
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


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

    assert are_alike(sample(found), sample(before)) == alike


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> list[FinderProcess]:
    """Processes of finders; each solver starts one."""
    started = list[FinderProcess]()

    def start(estimator: Estimator) -> FinderProcess:
        started.append(FinderProcess(estimator))
        return started[-1]

    monkeypatch.setattr("app.measurement.live_solver.FinderProcess", start)
    return started


@pytest.mark.slow
def test_process_finds_what_a_finder_in_this_process_finds(
    paper_bench: SmallBench, layered: Reconstructor, apart: list[FinderProcess]
) -> None:
    estimator = estimator_with(layered, bench_of(paper_bench), paper_bench.reference)
    solver, displacement = LiveSolver(estimator), layered.register(behind_layer(paper_bench, -0.8))
    try:
        _, (sample, refinement) = until_ratio(solver, displacement, -0.8)
        later = solver.solve(displacement, time.monotonic())[1].sample
    finally:
        solver.close()
    here = Finder(estimator)
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
    wait_until(lambda: not any(thread.name == "live-solver" for thread in threading.enumerate()))
    assert not raised


@pytest.mark.slow
@pytest.mark.parametrize("has_found", [True, False])
def test_process_that_dies_is_reported_and_frames_go_on(
    paper_bench: SmallBench,
    layered: Reconstructor,
    apart: list[FinderProcess],
    capsys: pytest.CaptureFixture[str],
    *,
    has_found: bool,
) -> None:
    solver = solver_of(paper_bench, layered)
    if has_found:
        until(solver, layered, paper_bench.reference, "applied")
    apart[0].process.kill()
    until(solver, layered, paper_bench.reference, "failed")
    _, (sample, state) = solver.solve(layered.register(paper_bench.reference), 0.0)
    assert sample is not None  # nobody waits for one
    assert state.problem == "the process that finds layers and corrections has ended: take the reference again"
    solver.close()
    wait_until(lambda: not any(thread.name == "live-solver" for thread in threading.enumerate()))
    assert capsys.readouterr().err == f"svwfs: {state.problem}\n"


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
    assert not solver.has_finder
    displacement = reconstructor.register(bowl(paper_bench, 1.0))
    wavefront, assumed = solver.solve(displacement, 0.0)
    assert assumed == (FREE, RefinementState())
    np.testing.assert_array_equal(wavefront.views, reconstructor.solve(displacement).views)
    assert not any(thread.name == "live-solver" for thread in set(threading.enumerate()) - before)
