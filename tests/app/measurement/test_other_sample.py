"""Frames of another sample than the one whose layers were found: no wrong wavefront without a badge."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.patience import HANG_S

from app.bench.config import load_bench
from app.evaluation.frames import NoiseFreeFrame, NoiseFreeFrames, exposure_of, seeded, with_screen
from app.measurement.averages import Average
from app.measurement.background_estimator import Found, LiveEstimator
from app.measurement.calibration import Calibration
from app.measurement.estimator import Estimator
from reconstruction.arrays import Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.runtime.deferred import Deferred
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront
from simulated_devices.detector import Detector

_AVERAGED, _QUANTUM_EFFICIENCY = 20, 0.9
_FAR_M, _NEAR_M = 0.195, 0.02  # that of the bench, and another


class Setup:
    """The preset small_demo, whose frames have some electrons in the reference's brightest pixel."""

    def __init__(self, mask: str, peak_e: float, *, refine: bool = False) -> None:
        settings = f"simulation.source.mask={mask}", f"reconstruction.refine={str(refine).lower()}"
        self.bench = load_bench("small_demo", settings)
        self._detector, self._exposed = Detector(self.bench.camera_model, seed=1), 0
        reference = NoiseFreeFrames(self.bench).reference()
        self._light = np.float32(peak_e / (_QUANTUM_EFFICIENCY * reference.max()))
        dark, lit = (self._average(light * reference) for light in (np.float32(0), np.float32(1)))
        full_scale = 2.0**self.bench.camera_model.bits - 1
        self.estimator = Estimator(Calibration.of(self.bench, lit, dark=dark, full_scale=full_scale))
        self.reconstructor = self.estimator.reconstructor

    def registered(self, frame: NoiseFreeFrame) -> Displacement:
        """Displacements of a frame with new noise."""
        with one_blas_thread():
            return self.reconstructor.register(self.counts(frame.photons))

    def counts(self, photons: Image) -> NDArray[np.uint16]:
        self._exposed += 1
        return self._detector.counts(photons * self._light, exposure_of(self.bench.camera_model, self._exposed))

    def _average(self, photons: Image) -> Average:
        counts, camera = np.stack([self.counts(photons) for _ in range(_AVERAGED)]), self.bench.camera_model
        return Average(
            mean=counts.mean(axis=0, dtype=np.float32),
            variance=counts.var(axis=0, ddof=1, dtype=np.float32),
            frames=_AVERAGED,
            exposure_s=camera.exposure_s,
            em_gain=camera.em_gain,
            amplifier=camera.amplifier,
        )


@cache
def behind(mask: str, distance_m: float, seed: int = 1, state: int = 0) -> NoiseFreeFrame:
    """A frame behind a screen, which drifts by a millimetre from one state to the next, and its truth."""
    bench = load_bench("small_demo", (f"simulation.source.mask={mask}", "simulation.drifting_states=4"))
    drifting = with_screen(bench, distance_m=distance_m, drift_x_m_per_s=1e-2 * (state > 0))
    return NoiseFreeFrames(*seeded(drifting, range(1), first=seed)).frame(state=state)


def error_sigmas(wavefront: Wavefront, truth: Floats) -> float:
    """RMS error of a wavefront, without piston, over the RMS of its error bars."""
    error = wavefront.views - truth
    error -= np.nanmean(error, axis=(2, 3), keepdims=True)
    return float(np.sqrt(np.nanmean(error**2) / np.nanmean(wavefront.sigma() ** 2)))


def distance_m(sample: AssumedSample | None) -> float:
    assert sample is not None
    assert len(sample.ratios) == 1
    return -0.2 * sample.ratios[0]


@pytest.fixture(scope="module")
def setup() -> Setup:
    return Setup("optimised", 10_000)


@pytest.fixture(scope="module")
def layer(setup: Setup) -> AssumedSample:
    """The bench's own layer."""
    with one_blas_thread():
        found = setup.reconstructor.find_sample(setup.registered(behind("optimised", _FAR_M)))
    assert distance_m(found) == pytest.approx(_FAR_M, abs=2e-3)
    return found


@pytest.fixture
def live(setup: Setup, layer: AssumedSample) -> LiveEstimator:
    """A live estimator that has found that layer and searches no more."""
    solver = LiveEstimator(setup.estimator)
    solver.close()
    solver._found = Found(layer)
    return solver


@pytest.mark.slow
@pytest.mark.parametrize(("other_m", "seed"), [(_NEAR_M, 1), (0.18, 2), (0.25, 3)])
def test_frame_of_another_sample_is_solved_for_any_wavefront(
    setup: Setup, live: LiveEstimator, layer: AssumedSample, other_m: float, seed: int
) -> None:
    other = behind("optimised", other_m, seed)
    registered = setup.registered(other)
    wavefront, assumed = live.solve(registered, 1.0)
    for each in (assumed, live.as_before(2.0)):  # the latter of a skipped frame
        assert (each.sample, each.is_other) == (None, True)
    assert wavefront.sample.ratios == ()
    assert error_sigmas(wavefront, other.truth) < 3
    assert error_sigmas(setup.reconstructor.solve(registered, sample=layer), other.truth) > 3


@pytest.mark.slow
@pytest.mark.long
def test_exchanged_sample_has_the_badge_until_it_is_found(setup: Setup) -> None:
    solver, begin_s, flagged = LiveEstimator(setup.estimator), time.monotonic(), 0
    try:
        for frame, expected_m in ((behind("optimised", _FAR_M), _FAR_M), (behind("optimised", _NEAR_M), _NEAR_M)):
            while True:
                wavefront, assumed = solver.solve(setup.registered(frame), time.monotonic())
                assert error_sigmas(wavefront, frame.truth) < 3
                flagged += assumed.is_other
                if assumed.sample is not None and distance_m(assumed.sample) == pytest.approx(expected_m, abs=2e-3):
                    break
                assert time.monotonic() - begin_s < HANG_S
                time.sleep(0.05)
    finally:
        solver.close()
    assert flagged


@pytest.mark.slow
def test_frame_of_a_file_has_its_own_search_and_leaves_live_frames_alone(
    setup: Setup, live: LiveEstimator, layer: AssumedSample
) -> None:
    own, other = behind("optimised", _FAR_M), behind("optimised", _NEAR_M)
    wavefront, assumed = live.solve_single(setup.registered(other), is_foreign=True)
    assert distance_m(assumed.sample) == pytest.approx(_NEAR_M, abs=2e-3)
    assert error_sigmas(wavefront, other.truth) < 3
    left, right = np.hsplit(other.photons, 2)  # a frame of no sample at all
    live.solve_single(setup.registered(replace(other, photons=np.hstack([right, left]))), is_foreign=True)
    wavefront, assumed = live.solve(setup.registered(own), 2.0)
    assert (assumed.sample, assumed.is_other) == (layer, False)
    assert error_sigmas(wavefront, own.truth) < 3


@pytest.mark.slow
def test_single_frame_of_a_recording_is_searched_only_if_it_contradicts_the_layers(
    setup: Setup, live: LiveEstimator, layer: AssumedSample, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, other = behind("optimised", _FAR_M), behind("optimised", _NEAR_M)
    found = AssumedSample((-0.1,))
    monkeypatch.setattr(type(setup.reconstructor), "find_sample", lambda *_: found)
    for frame, expected in ((own, layer), (other, found)):
        assert live.solve_single(setup.registered(frame), is_foreign=False)[1].sample is expected
    assert live.solve_single(setup.registered(own), is_foreign=True)[1].sample is found


@pytest.mark.slow
def test_swapped_halves_have_the_badge(setup: Setup, live: LiveEstimator) -> None:
    own = behind("optimised", _FAR_M)
    left, right = np.hsplit(own.photons, 2)
    swapped = setup.registered(replace(own, photons=np.hstack([right, left])))
    assert live.solve(swapped, 1.0)[1].is_other


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("mask", ["optimised", "square"])
@pytest.mark.parametrize("peak_e", [200, 1000, 10_000])
def test_drifting_sample_of_the_same_layer_has_no_badge(mask: str, peak_e: float) -> None:
    setup = Setup(mask, peak_e)
    with one_blas_thread():
        sample = setup.reconstructor.find_sample(setup.registered(behind(mask, _FAR_M)))
        assert sample.ratios
        for state in (0, 1, 2, 3, 1, 2, 3):
            registered = setup.registered(behind(mask, _FAR_M, state=state))
            assert not setup.reconstructor.contradicts(setup.reconstructor.solve(registered, sample=sample))


@pytest.mark.slow
def test_distance_and_misfit_are_tested_each(setup: Setup, layer: AssumedSample) -> None:
    """A shift of the layers shows before they leave more than noise, a misfit may have no such cause."""
    made = setup.reconstructor

    def contradiction(other_m: float, seed: int, **changes: Any) -> float:
        wavefront = made.solve(setup.registered(behind("optimised", other_m, seed)), sample=layer)
        return made.contradiction(replace(wavefront, solution=replace(wavefront.solution, **changes)))

    assert contradiction(0.18, 2, noise=1.0) > 1.5
    assert contradiction(_NEAR_M, 1, shift_sigmas=Deferred(lambda: 0.0)) > 5
    assert contradiction(_FAR_M, 1, shift_sigmas=Deferred(lambda: 0.0)) == 0


@pytest.mark.slow
def test_darker_frame_of_the_same_layer_has_no_badge(setup: Setup, live: LiveEstimator) -> None:
    """Its chi-square is larger, for any wavefront, too."""
    own = behind("optimised", _FAR_M)
    registered = setup.registered(replace(own, photons=own.photons * np.float32(0.4)))
    wavefront, assumed = live.solve(registered, 1.0)
    assert isinstance(wavefront.solution, ModalSolution)
    assert wavefront.solution.noise > 2
    assert not assumed.is_other


@pytest.mark.slow
def test_search_that_decides_against_the_test_is_believed(setup: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else frames of a sample whose misfit is large would be searched again and again."""
    other = setup.registered(behind("optimised", _NEAR_M))
    far = AssumedSample((-_FAR_M / 0.2,), np.full((1, 1), 1e-6))
    monkeypatch.setattr("reconstruction.reconstructor.most_probable", lambda *_, **__: far)
    with one_blas_thread():
        found = setup.reconstructor.find_sample(other)
        assert found.allowed > 1
        assert not setup.reconstructor.contradicts(setup.reconstructor.solve(other, sample=found))
        assert setup.reconstructor.contradicts(setup.reconstructor.solve(other, sample=far))


@pytest.mark.slow
@pytest.mark.long
def test_correction_of_another_sample_is_not_applied() -> None:
    setup = Setup("optimised", 10_000, refine=True)
    own, other = behind("optimised", _FAR_M), behind("optimised", _NEAR_M)
    solver, begin_s = LiveEstimator(setup.estimator), time.monotonic()
    try:
        for frame in (own, other):
            stage = ""
            while stage != "applied":
                wavefront, (sample, state, is_other) = solver.solve(setup.registered(frame), time.monotonic())
                stage = state.stage
                assert error_sigmas(wavefront, frame.truth) < 3
                assert (sample is None) >= is_other
                assert not (is_other and state.bias is not None)
                assert time.monotonic() - begin_s < HANG_S
                time.sleep(0.05)
    finally:
        solver.close()
