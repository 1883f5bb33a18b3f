"""The detector's statistics against SciPy and closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy  # which loads its parts when they are used
from numpy.typing import NDArray
from scipy import special

from simulated_devices.detector import Detector, FrameConditions, normal
from simulated_devices.settings import SimulatedCameraSettings

# One electron per count, no read noise, no offset: counts are electrons.
BARE = SimulatedCameraSettings(
    quantum_efficiency=1.0,
    dark_current_e_per_s=0.0,
    clock_induced_charge_e=0.0,
    em_read_noise_e=(0.0, 0.0, 0.0),
    normal_read_noise_e=0.0,
    electrons_per_count=1.0,
    offset_counts=0.0,
)
NORMAL = FrameConditions(index=0, exposure_s=1.0, amplifier="normal", readout_speed=3, em_gain=1.0)
SHAPE = (400, 500)
PIXELS = SHAPE[0] * SHAPE[1]


@pytest.fixture
def bare() -> Detector:
    return Detector(BARE, seed=11)


def flat(photons: float) -> NDArray[np.float32]:
    return np.full(SHAPE, photons, np.float32)


def counts_with(photons: float, exposure: FrameConditions = NORMAL, **settings: float) -> NDArray[np.float64]:
    detector = Detector(replace(BARE, **settings), seed=3)  # type: ignore[arg-type] # settings by name
    counts = detector.counts(flat(photons), exposure)
    return counts.astype(np.float64)


@pytest.mark.parametrize("mean", [0.05, 0.7, 3.0, 5.9, 6.1, 20.0, 300.0])
def test_shot_noise_is_poisson(bare: Detector, mean: float) -> None:
    counts = bare.counts(flat(mean), NORMAL).ravel()
    largest = int(counts.max()) + 1
    expected = scipy.stats.poisson.pmf(np.arange(largest), np.float32(mean)) * PIXELS
    expected = np.append(expected, PIXELS - expected.sum())
    observed = np.bincount(counts, minlength=largest + 1)
    frequent = expected > 20
    observed = np.append(observed[frequent], observed[~frequent].sum())
    expected = np.append(expected[frequent], expected[~frequent].sum())
    chi_square = float(((observed - expected) ** 2 / expected).sum())
    # Where Poisson is an expansion it is wrong by less than 1e-4 a pixel in chi square.
    allowed = float(scipy.stats.chi2.isf(1e-4, len(expected) - 1)) + (1e-4 * PIXELS if mean > 6 else 0.0)
    assert chi_square < allowed


def test_efficiency_dark_current_and_clock_induced_charge_add_up() -> None:
    counts = counts_with(
        1000.0,
        replace(NORMAL, exposure_s=2.0),
        quantum_efficiency=0.8,
        dark_current_e_per_s=50.0,
        clock_induced_charge_e=25.0,
    )
    expected = 0.8 * 1000 + 2 * 50 + 25
    assert counts.mean() == pytest.approx(expected, abs=5 * math.sqrt(expected / PIXELS))
    assert counts.var() == pytest.approx(expected, rel=5 * math.sqrt(2 / PIXELS))


@pytest.mark.parametrize(("amplifier", "noise"), [("normal", 10.0), ("em", 37.0)])
def test_each_amplifier_has_its_read_noise_and_offset(amplifier: str, noise: float) -> None:
    settings = replace(BARE, em_read_noise_e=(8.0, 25.0, 37.0), normal_read_noise_e=10.0, offset_counts=500.0)
    detector = Detector(settings, seed=5)
    exposure = replace(NORMAL, amplifier=amplifier)  # type: ignore[arg-type] # both literals, from parametrize
    counts = detector.counts(flat(0.0), exposure).astype(float).ravel()
    assert counts.mean() == pytest.approx(500.0, abs=5 * noise / math.sqrt(PIXELS))
    assert counts.std() == pytest.approx(math.hypot(noise, math.sqrt(1 / 12)), rel=0.01)
    even = counts + np.random.default_rng(0).uniform(-0.5, 0.5, PIXELS)
    assert scipy.stats.kstest((even - 500) / noise, "norm").pvalue > 1e-4


def test_shot_noise_and_read_noise_are_independent() -> None:
    counts = counts_with(900.0, normal_read_noise_e=30.0)
    assert counts.var() == pytest.approx(900 + 30**2 + 1 / 12, rel=5 * math.sqrt(2 / PIXELS))


@pytest.mark.parametrize("em_gain", [1.5, 4.0, 50.0])
@pytest.mark.parametrize("mean", [2.0, 30.0, 300.0])
def test_multiplication_has_mean_and_excess_noise_of_birth_process(mean: float, em_gain: float) -> None:
    exposure = replace(NORMAL, amplifier="em", em_gain=em_gain)
    counts = counts_with(mean, exposure)
    excess = 2 - 1 / em_gain  # F^2: variance over that of noiseless multiplication; 2 for large gain
    deviation = math.sqrt(mean * excess) * em_gain
    assert counts.mean() == pytest.approx(mean * em_gain, abs=5 * deviation / math.sqrt(PIXELS))
    assert counts.var() == pytest.approx(deviation**2 + 1 / 12, rel=0.02)


@pytest.mark.parametrize("mean", [1.5, 10.0, 60.0])
def test_multiplied_electrons_are_distributed_as_in_a_register(mean: float) -> None:
    em_gain = 100.0
    counts = counts_with(mean, replace(NORMAL, amplifier="em", em_gain=em_gain)).ravel()
    generator = np.random.default_rng(1)
    electrons = generator.poisson(mean, PIXELS)
    truth = electrons + generator.negative_binomial(np.maximum(electrons, 1), 1 / em_gain) * (electrons > 0)
    assert scipy.stats.ks_2samp(counts, truth).statistic < 1.95 * math.sqrt(2 / PIXELS) + 0.002


@pytest.mark.parametrize("noise", [3.0, 37.0])
@pytest.mark.parametrize("em_gain", [1.0, 7.0, 100.0])
@pytest.mark.parametrize("mean", [0.01, 1.0, 6.0, 15.0, 60.0])
def test_all_noise_together_is_distributed_as_step_by_step(mean: float, em_gain: float, noise: float) -> None:
    exposure = replace(NORMAL, amplifier="em", em_gain=em_gain)
    counts = counts_with(mean, exposure, em_read_noise_e=(noise,) * 3, offset_counts=500.0).ravel()  # type: ignore[arg-type] # three numbers
    generator = np.random.default_rng(1)
    electrons = generator.poisson(mean, PIXELS).astype(float)
    if em_gain > 1:
        electrons += generator.negative_binomial(np.maximum(electrons, 1), 1 / em_gain) * (electrons > 0)
    truth = np.floor(np.maximum(electrons + generator.normal(0, noise, PIXELS) + 500.5, 0))
    largest = max(truth.std() * 5 / math.sqrt(PIXELS), 1e-3)
    assert counts.mean() == pytest.approx(mean * em_gain + 500, abs=2 * largest)
    assert scipy.stats.ks_2samp(counts, truth).statistic < 1.95 * math.sqrt(2 / PIXELS) + 0.002


def test_gain_one_and_normal_amplifier_do_not_multiply() -> None:
    plain = counts_with(40.0)
    np.testing.assert_array_equal(plain, counts_with(40.0, replace(NORMAL, amplifier="em", em_gain=1.0)))
    np.testing.assert_array_equal(plain, counts_with(40.0, replace(NORMAL, em_gain=100.0)))


def test_full_well_register_and_converter_saturate() -> None:
    assert (counts_with(50_000.0, full_well_e=20_000.0) == 20_000).all()
    assert (counts_with(90_000.0) == 65_535).all()
    assert (counts_with(90_000.0, bits=12) == 4095).all()
    em = replace(NORMAL, amplifier="em", em_gain=100.0)
    assert (counts_with(30_000.0, em, register_full_well_e=40_000.0) == 40_000).all()


def test_counts_are_electrons_over_the_conversion_factor() -> None:
    counts = counts_with(100_000.0, electrons_per_count=5.8, offset_counts=500.0)
    assert counts.mean() == pytest.approx(100_000 / 5.8 + 500, abs=1.0)


def test_frame_depends_only_on_seed_and_index(bare: Detector) -> None:
    photons = flat(50.0)
    first = bare.counts(photons, NORMAL)
    other = bare.counts(photons, replace(NORMAL, index=1))
    np.testing.assert_array_equal(bare.counts(photons, NORMAL), first)
    seeded = Detector(BARE, seed=12)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.01
    assert abs(np.corrcoef(first.ravel(), seeded.counts(photons, NORMAL).ravel())[0, 1]) < 0.01
    assert abs(np.corrcoef(first[:, 1:].ravel(), first[:, :-1].ravel())[0, 1]) < 0.01
    assert (photons == 50).all()


def test_normal_deviates_follow_the_quantile_function() -> None:
    bits = np.concatenate([np.geomspace(1, 2**31, 500), 2**32 - np.geomspace(1, 2**31, 500)]).astype(np.uint64)
    deviates = [normal(value) for value in bits]
    np.testing.assert_allclose(deviates, special.ndtri((bits.astype(float) + 0.5) / 2**32), atol=2e-4)
