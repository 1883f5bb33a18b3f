"""The transmission of a sample is that of the simulator's screen where the rays of each view cross it."""

from __future__ import annotations

import time
from functools import cache

import numpy as np
import pytest
from support.patience import HANG_S

from app.bench.config import Bench, load_bench
from app.evaluation.frames import NoiseFreeFrames
from app.evaluation.mask_accuracy import calibration_of
from app.measurement.background_estimator import LiveEstimator
from app.measurement.estimator import Estimator
from app.measurement.offline_reconstructor import reconstructor as reconstructor_of
from app.results.dataset import result_dataset
from reconstruction.arrays import Floats, Image
from reconstruction.frame.noise import CameraNoise
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.wavefront import mean_rms

READ_NOISE_E = 8.0
RAYS = (np.arange(8) - 3.5) / 8  # across a lenslet, in pitches


@cache
def absorbing(mask: str) -> tuple[Bench, Image, Image, Floats]:
    """Bench, noise-free reference and frame of a sample with 16 % RMS absorption, and the truth, shaped like views."""
    bench = load_bench("small_demo", (f"simulation.source.mask='{mask}'", "simulation.screen.transmission_rms=0.16"))
    frames, sensor, field = NoiseFreeFrames(bench), bench.sensor, bench.field
    amplitude = frames.sample.amplitude
    assert amplitude is not None
    ratio = bench.simulation.screen.distance_m / field.collimator_focal_length_m
    x_m = sensor.lenslet_centers_m[..., 0] - ratio * field.view_x_m[:, None, None]
    y_m = sensor.lenslet_centers_m[..., 1] - ratio * field.view_y_m[:, None, None, None]
    about_m = RAYS * sensor.lenslet_pitch_m
    truth = np.mean([amplitude.at(x_m + x, y_m + y) ** 2 for x in about_m for y in about_m], axis=0)
    return bench, frames.reference(), frames.frame().photons, truth


def measured(mask: str, peak_e: float, seed: int = 0) -> tuple[Floats, Floats]:
    """Transmission and its error from a frame of so many electrons in the reference's brightest pixel, or no noise."""
    bench, reference, frame, _ = absorbing(mask)
    scale = np.float32((peak_e or 1e5) / reference.max())
    electrons, offset = frame * scale, 100
    if peak_e:
        random = np.random.default_rng(seed)
        electrons = random.poisson(electrons) + READ_NOISE_E * random.standard_normal(frame.shape)
    images = (np.maximum(image + offset, 0).astype(np.float32) for image in (reference * scale, electrons))
    reference, frame = images
    made = reconstructor_of(bench, reference, dark=np.full_like(reference, offset), frame=frame)(frame)
    dataset = result_dataset(made)
    return dataset["transmission"].to_numpy(), dataset["transmission_sigma"].to_numpy()


@pytest.mark.slow
@pytest.mark.parametrize("peak_e", [0, 1000])
@pytest.mark.parametrize("mask", ["square", "checkerboard", "optimised"])
def test_map_is_that_of_the_sample(mask: str, peak_e: float) -> None:
    truth = absorbing(mask)[-1]
    found, _ = measured(mask, peak_e)
    known = np.isfinite(found)
    assert known.mean() > 0.9
    assert np.corrcoef(found[known], truth[known])[0, 1] > 0.95
    assert found[known].mean() == pytest.approx(truth[known].mean(), rel=0.03)
    assert found[known].std() == pytest.approx(truth[known].std(), rel=0.08)


@pytest.mark.slow
@pytest.mark.parametrize(("mask", "most_rad"), [("square", 0.03), ("checkerboard", 0.01), ("optimised", 0.01)])
def test_absorption_is_hardly_a_wavefront(mask: str, most_rad: float) -> None:
    """With a brightness that is only linear over the field, square and checkerboard left 0.14 and 0.046 rad."""
    bench, reference, frame, _ = absorbing(mask)
    scale, noise = (
        np.float32(1e5 / reference.max()),
        CameraNoise(counts_per_electron=1.0, read_noise_counts=READ_NOISE_E),
    )
    reconstructor = calibration_of(bench, reference * scale, noise=noise).reconstructor()
    wavefront = reconstructor(frame * scale)
    assert len(wavefront.sample.ratios) == 1
    assert mean_rms(wavefront.views - NoiseFreeFrames(bench).frame().truth) < most_rad


@cache
def clear_and_absorbing() -> tuple[Estimator, Image, Image]:
    """An estimator that knows the noise, and noisy frames of a clear sample and of one that absorbs, counts."""
    bench, reference, absorbed, _ = absorbing("checkerboard")
    clear = NoiseFreeFrames(load_bench("small_demo", ("simulation.source.mask='checkerboard'",))).frame().photons
    scale, random = np.float32(1e4 / reference.max()), np.random.default_rng(1)
    noise = CameraNoise(counts_per_electron=1.0, read_noise_counts=READ_NOISE_E)
    estimator = Estimator(calibration_of(bench, reference * scale, noise=noise))

    def noisy(frame: Image) -> Image:
        electrons = random.poisson(frame * scale) + READ_NOISE_E * random.standard_normal(frame.shape)
        return electrons.astype(np.float32)

    return estimator, noisy(clear), noisy(absorbed)


def test_frame_shows_whether_its_sample_absorbs() -> None:
    estimator, *frames = clear_and_absorbing()
    reconstructor = estimator.reconstructor
    for frame, absorbs in zip(frames, (False, True), strict=True):
        found = reconstructor.register(frame)
        assert found.absorbs == absorbs
        for told in (False, True):
            registered = reconstructor.register(frame, start=found, absorbs=told)
            assert registered.absorbs == told
            assert reconstructor.shows_absorption(registered) == absorbs
    before, frame = reconstructor.register(frames[0]), frames[1]
    live, replayed = (reconstructor.register(frame, start=before, absorbs=known) for known in (None, True))
    np.testing.assert_array_equal(live.coefficients, replayed.coefficients)
    assert reconstructor.absorbing.absorbing is reconstructor.absorbing


@pytest.mark.slow
def test_wavefront_behind_a_sample_that_absorbs_is_refined() -> None:
    estimator, _, absorbed = clear_and_absorbing()
    with one_blas_thread():
        wavefront = estimator.reconstructor(absorbed)
        bias = estimator.refinement.bias(wavefront)
    assert wavefront.displacement.absorbs
    assert bias.misfit_px(wavefront.displacement) < 0.1


@pytest.mark.slow
def test_live_frames_follow_another_kind_of_sample() -> None:
    estimator, clear, absorbed = clear_and_absorbing()
    reconstructor, live, seen, begin_s = estimator.reconstructor, LiveEstimator(estimator), [], time.monotonic()
    try:
        for frame in (clear, absorbed, clear):
            absorbs, before = frame is absorbed, live.absorbs
            while live.absorbs is not absorbs:
                with one_blas_thread():
                    live.solve(reconstructor.register(frame, absorbs=bool(before)), time.monotonic())
                assert time.monotonic() < begin_s + HANG_S
                time.sleep(0.05)
            seen.append(live.absorbs)
    finally:
        live.close()
    assert seen == [False, True, False]


@pytest.mark.slow
@pytest.mark.long
def test_error_is_the_scatter_by_noise() -> None:
    draws = np.array([measured("checkerboard", 1000, seed) for seed in range(6)])
    scatter = np.sqrt(np.nanmean(np.nanvar(draws[:, 0], axis=0, ddof=1)))
    assert scatter == pytest.approx(np.sqrt(np.nanmean(draws[:, 1] ** 2)), rel=0.1)
