"""Photon transfer on simulated frames of known noise, and the warp chosen by the noise."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import curve_fit
from support.optics import SmallBench

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument
from app.bench.config import load_bench
from reconstruction.arrays import Floats, Image
from reconstruction.frame.noise import CameraNoise, TransferCurve, image_transfer, photon_transfer
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, SampleModel
from simulated_devices.detector import Detector, FrameConditions
from simulated_devices.settings import SimulatedCameraSettings

ROWS = COLUMNS = 256
BENCH = SmallBench(9, 9)
LIGHT = BENCH.reference / BENCH.reference.max()


@pytest.mark.parametrize(("em_gain", "frames"), [(1.0, 20), (50.0, 20), (50.0, 5)])
def test_photon_transfer_recovers_noise_of_simulated_camera(em_gain: float, frames: int) -> None:
    settings = SimulatedCameraSettings(rows=ROWS, columns=COLUMNS, em_gain=em_gain)
    detector = Detector(settings, seed=3)
    ramp = np.linspace(0, 3000 / em_gain**0.5, ROWS * COLUMNS, dtype=np.float32).reshape(ROWS, COLUMNS)

    def stack(photons: np.ndarray, first: int) -> np.ndarray:
        exposures = (
            FrameConditions(index=i, exposure_s=0.02, amplifier="em", readout_speed=3, em_gain=em_gain)
            for i in range(first, first + frames)
        )
        return np.array([detector.counts(photons, exposure) for exposure in exposures], np.float64)

    dark, light = stack(np.zeros_like(ramp), 0), stack(ramp, 100)
    curve = photon_transfer(
        (light.mean(axis=0) - dark.mean(axis=0)).astype(np.float32),
        light.var(axis=0, ddof=1).astype(np.float32),
        frames=frames,
        dark_variance=dark.var(axis=0, ddof=1).astype(np.float32),
    )
    assert curve is not None
    assert curve.loss < 0.05
    noise = curve.noise
    assert noise is not None
    # After a register of gain G the variance of n electrons is n (2 G^2 - G): excess noise 2 - 1 / G.
    expected = em_gain / settings.electrons_per_count * (2 - 1 / em_gain)
    assert noise.counts_per_light == pytest.approx(expected, rel=0.03)
    read_noise_counts = np.hypot(settings.em_read_noise_e[2] / settings.electrons_per_count, 12**-0.5)
    assert noise.read_noise_counts == pytest.approx(read_noise_counts, rel=0.05)


def test_photon_transfer_without_light_or_frames_returns_none() -> None:
    flat = np.ones((8, 8), np.float32)
    assert photon_transfer(flat, flat, frames=3, dark_variance=flat) is None
    curve = photon_transfer(flat, flat * 0, frames=20, dark_variance=flat)
    assert curve is not None
    assert curve.noise is None
    assert curve.loss == 0


def response_curves() -> dict[str, Callable[[Floats], Floats]]:
    """Counts over the brightest ones, against the light over the brightest."""
    saturating = {f"well {k:g}": lambda s, k=k: k * (1 - np.exp(-s / k)) for k in (0.5, 1, 2, 20)}
    return {"line": lambda s: s, **saturating, "gamma": lambda s: np.maximum(s, 0) ** 0.7}


@pytest.mark.parametrize("peak_e", [300.0, 3e4])
@pytest.mark.parametrize(
    ("response", "least", "most"),
    [("line", 0, 0.01), ("well 20", 0, 0.1), ("well 2", 0.4, 0.7), ("well 1", 0.7, 2), ("gamma", 0.3, 0.7)],
)
def test_loss_of_compressed_counts_is_measured(response: str, least: float, most: float, peak_e: float) -> None:
    """From single frames and from several; light that flickers only adds noise."""
    generator = np.random.default_rng(0)
    curve, light = response_curves()[response], LIGHT * peak_e

    def exposed(flicker: float) -> Image:
        electrons = generator.poisson(light * (1 + flicker * generator.normal()))
        counts = curve(electrons / peak_e) * peak_e + generator.normal(0, 3, light.shape)
        return np.asarray(np.rint(counts), np.float32)

    flicker = 2e-3 if response == "line" else 0.0
    frames = np.stack([exposed(flicker) for _ in range(8)])
    dark_variance = np.full(light.shape, 9.0, np.float32)
    found = photon_transfer(frames.mean(axis=0), frames.var(axis=0, ddof=1), frames=8, dark_variance=dark_variance)
    assert found is not None
    assert least <= found.loss <= most
    single = image_transfer(frames[0], BENCH.sensor.blur_px)
    if response != "gamma":  # a gamma makes images that no optics transmits
        assert single is not None
        assert 0.5 * least <= single.loss <= most


def test_loss_is_the_bend_beyond_four_standard_errors() -> None:
    """Against the weighted fit of SciPy, which scales its errors with the scatter, too."""
    light = np.linspace(200, 1000, 20)
    share, scatter = light / light.max(), 1 + 0.02 * np.random.default_rng(0).normal(size=20)
    variance = (9 + 2000 * share - 600 * share**2) * scatter
    (slope, bend), covariance = curve_fit(
        lambda s, a, b: a * s + b * s**2, share, variance - 9, p0=(1, 0), sigma=variance, absolute_sigma=False
    )
    expected = -(bend + 4 * np.sqrt(covariance[1, 1])) / slope
    assert 0.1 < expected < 0.9 * -bend / slope  # far from both limits, and moved by the error
    assert TransferCurve(light, variance, 9.0).loss == pytest.approx(expected, rel=1e-4)


def bent(bend: float, brightest: float = 1000.0, *, scatter: float = 0.0) -> TransferCurve:
    """Curve of 9 + 2 light (1 + bend light / brightest), counts^2."""
    light = np.linspace(0.15, 1, 20) * brightest
    noise = 1 + scatter * np.random.default_rng(3).normal(size=light.size)
    return TransferCurve(light, (9 + 2 * light * (1 + bend * light / brightest)) * noise, 9.0)


def test_difference_of_curves_is_taken_where_both_are_bright() -> None:
    """Bends of 0.4 and -0.2 at 1000 counts; at 500 counts half as much."""
    assert bent(0.4).difference(bent(-0.2), 1) == pytest.approx(0.6)
    assert bent(-0.2).difference(bent(0.4), 1) == pytest.approx(0.6)
    dimmer = bent(-0.1, 500)  # the same curve
    assert dimmer.difference(bent(-0.2), 1) == pytest.approx(0, abs=1e-9)
    assert dimmer.difference(bent(0.4), 1) == pytest.approx(0.3)


def test_uneven_pixels_bend_the_curve_of_an_average_more() -> None:
    """Of 8 frames up to 8 times as much as that of one; a bend beyond is another response."""
    average = bent(0.8)
    for bend in (0.1, 0.3, 0.8):
        assert bent(bend).difference(average, 8) == pytest.approx(0, abs=1e-9)
    assert bent(-0.2).difference(average, 8) == pytest.approx(0.3)
    assert bent(1.0).difference(average, 8) == pytest.approx(0.2)
    assert bent(0.1).difference(average, 1) == pytest.approx(0.7)


def test_curve_without_noise_is_like_any_other() -> None:
    flat = TransferCurve(np.linspace(100, 1000, 20), np.full(20, 9.0), 9.0)
    assert flat.loss == flat.difference(bent(-0.9), 1) == bent(-0.9).difference(flat, 1) == 0


def test_difference_of_scattered_curves_is_no_difference() -> None:
    assert bent(0.1, scatter=0.05).difference(bent(0.1), 1) == 0
    certain, uncertain = bent(0.3), replace(bent(-0.1), relative_error=0.2)  # bins that agree by chance
    assert certain.difference(bent(-0.1), 1) == pytest.approx(0.4)
    assert certain.difference(uncertain, 1) == 0
    assert bent(0.1, scatter=0.005).difference(bent(-0.5), 1) == pytest.approx(0.6, abs=0.1)


def test_stray_light_and_hot_pixels_do_not_bias_image_noise() -> None:
    generator = np.random.default_rng(4)
    light = LIGHT * 2000 + 500.0
    image = (generator.poisson(light) + generator.normal(0, 3, light.shape)).astype(np.float32)
    image.ravel()[generator.choice(image.size, image.size // 500, replace=False)] += 300
    curve = image_transfer(image, BENCH.sensor.blur_px)
    assert curve is not None
    assert curve.noise is not None
    assert curve.loss == 0
    assert curve.noise.counts_per_light == pytest.approx(1, rel=0.1)
    assert curve.read_variance == pytest.approx(500 + 9, rel=0.1)  # where the light is least


@pytest.mark.parametrize(
    ("name", "peak_e", "sample", "warp"),
    [
        ("checker_bench", 1e6, "free", "quartic"),
        ("checker_bench", 30, "free", "quadratic"),
        ("checker_bench", 30, "automatic", "quartic"),  # layers tie its parameters together
        ("paper_bench", 1e6, "free", "quartic"),
        ("paper_bench", 30, "free", "quadratic"),
        ("small_bench", 1e6, "free", "quartic"),  # in real light a uniform square hides a part, which the prior bounds
        ("small_bench", 30, "layers", "quartic"),
    ],
)
def test_noise_mask_and_sample_decide_the_warp(
    request: pytest.FixtureRequest, name: str, peak_e: float, sample: SampleModel, warp: str
) -> None:
    bench: SmallBench = request.getfixturevalue(name)
    per_electron = float(bench.reference.max()) / peak_e
    reconstructor = bench.reconstructor(
        registration=RegistrationSettings(),
        reconstruction=ReconstructionSettings(sample=sample),
        noise=CameraNoise(per_electron, 8 * per_electron),
    )
    assert reconstructor.registration.warp == warp


def test_warp_is_chosen_with_few_lit_lenslets(checker_bench: SmallBench) -> None:
    columns = np.arange(checker_bench.frame_shape[1])
    reference = np.where(columns < 100, checker_bench.reference, 0).astype(np.float32)
    per_electron = float(reference.max()) / 3000
    reconstructor = checker_bench.reconstructor(
        reference=reference,
        registration=RegistrationSettings(),
        reconstruction=ReconstructionSettings(sample="free"),
        noise=CameraNoise(per_electron, 8 * per_electron),
    )
    assert reconstructor.registration.warp == "cubic"
    assert np.isfinite(reconstructor(reference).views[1, 1, :, :2]).all()


def test_warp_of_least_systematic_error_is_chosen_if_noise_is_unknown(checker_bench: SmallBench) -> None:
    assert checker_bench.reconstructor(registration=RegistrationSettings()).registration.warp == "quartic"


def test_instrument_measures_noise_from_dark_and_reference(small_toml: Path) -> None:
    bench = load_bench(small_toml)
    with open_devices(bench, lambda _: None) as devices, closing(Instrument(devices, bench)) as instrument:
        devices.light.set_on(True)
        instrument.take_dark(6)
        instrument.take_reference(6)
        assert instrument._estimator is not None
        reconstructor = instrument._estimator.reconstructor
        assert reconstructor.noise is not None
        settings = bench.camera_model
        expected = settings.em_gain / settings.electrons_per_count * (2 - 1 / settings.em_gain)
        assert reconstructor.noise.counts_per_light == pytest.approx(expected, rel=0.1)
        assert reconstructor.subimages.reference_frames == 6
