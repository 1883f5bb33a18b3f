"""Start of the registration from an earlier frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import FIELD, SmallBench

from reconstruction.arrays import Image
from reconstruction.displacement import Displacement, RegistrationMethod
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.registration import prepare_registration
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings

SAME = 0.25  # standard errors


@pytest.fixture(scope="module")
def frames(small_bench: SmallBench) -> list[Image]:
    """Frames of an aberration that drifts, with noise, electrons."""
    u, v = small_bench.samples()
    rng = np.random.default_rng(0)
    scale = np.float32(1000 / small_bench.reference.max())
    frames = []
    for step in range(4):
        bend = 3e5 + 2e4 * step

        def phase(x: float, _y: float, bend: float = bend) -> Image:
            return (bend * (u**2 + v**2) + 1500.0 * u + 4e5 * u * x).astype(np.float32)

        light = np.maximum(small_bench.frame(phase) * scale, 0)
        frames.append(np.asarray(rng.poisson(light) + rng.normal(0, 8, light.shape), np.float32))
    return frames


@pytest.fixture(scope="module", params=["quadratic", "affine"])
def estimate(request: pytest.FixtureRequest, small_bench: SmallBench) -> RegistrationMethod:
    return _prepared(small_bench, RegistrationSettings(warp=request.param))


def _prepared(bench: SmallBench, settings: RegistrationSettings) -> RegistrationMethod:
    reference = bench.reference * np.float32(1000 / bench.reference.max())
    subimages = ReferenceSubimages(
        reference, sensor=bench.sensor, lattice=bench.lattice, field=FIELD, noise=KnownNoise(CameraNoise(1.0, 8.0))
    )
    return prepare_registration(subimages, settings, FIELD)


def _differ(one: Displacement, other: Displacement) -> float:
    """Largest difference of two results in standard errors."""
    assert one.valid.all()
    assert other.valid.all()
    return float(np.max(np.abs(one.coefficients - other.coefficients) / np.sqrt(one.variance)))


def test_start_from_previous_frame_gives_same_result(estimate: RegistrationMethod, frames: list[Image]) -> None:
    nowhere = np.zeros(frames[0].shape, np.bool_)
    before = None
    for light in frames:
        warm = estimate(light, saturated=nowhere, start=before)
        assert _differ(warm, estimate(light, saturated=nowhere)) < SAME
        before = warm


@pytest.mark.parametrize("spoil", ["far", "wild", "lost", "turned", "tiny"])
def test_wrong_start_does_not_change_result(estimate: RegistrationMethod, frames: list[Image], spoil: str) -> None:
    nowhere = np.zeros(frames[0].shape, np.bool_)
    cold = estimate(frames[1], saturated=nowhere)
    rng = np.random.default_rng(1)
    coefficients = {
        "far": cold.coefficients + 6.0,
        "wild": rng.normal(0, 1e6, cold.coefficients.shape),
        "lost": np.full_like(cold.coefficients, np.nan),
        "turned": -cold.coefficients,
        "tiny": np.full_like(cold.coefficients, 1e-40),
    }[spoil]
    warm = estimate(frames[1], saturated=nowhere, start=replace(cold, coefficients=coefficients))
    assert _differ(warm, cold) < SAME


def test_start_that_is_no_gradient_does_not_survive(small_bench: SmallBench, frames: list[Image]) -> None:
    nowhere = np.zeros(frames[0].shape, np.bool_)
    estimate = _prepared(small_bench, RegistrationSettings(warp="quadratic", rotation=False))
    cold = estimate(frames[1], saturated=nowhere)
    turned = cold.coefficients.copy()
    turned[..., 1, 1] += 0.3  # a displacement (0.3 -y, 0.3 x)
    turned[..., 2, 0] -= 0.3
    warm = estimate(frames[1], saturated=nowhere, start=replace(cold, coefficients=turned))
    assert _differ(warm, cold) < SAME


def test_warm_fit_ends_far_within_its_error_bar(small_bench: SmallBench, frames: list[Image]) -> None:
    nowhere = np.zeros(frames[0].shape, np.bool_)
    estimate = _prepared(small_bench, RegistrationSettings(warp="quadratic", rotation=False))
    cold = estimate(frames[1], saturated=nowhere)
    repeated = cold
    for _ in range(4):  # always from the result before: the fixed point
        repeated = estimate(frames[1], saturated=nowhere, start=repeated)
    warm = estimate(frames[1], saturated=nowhere, start=estimate(frames[0], saturated=nowhere))
    off = (warm.coefficients - repeated.coefficients) / np.sqrt(warm.variance)
    assert np.abs(off).max() < SAME
    assert np.sqrt(np.mean(off**2)) < 0.05
    np.testing.assert_allclose(warm.chi_square, repeated.chi_square, rtol=0.1)  # it ignores the varying brightness
