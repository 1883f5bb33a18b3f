"""Start of the registration from an earlier frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import FIELD, SmallBench

from reconstruction.arrays import Image
from reconstruction.displacement import Displacement, RegistrationMethod
from reconstruction.frame.noise import CameraNoise
from reconstruction.registration.methods import prepare_registration
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import Method, RegistrationSettings

SAME_PX = 1e-3


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
        reference, sensor=bench.sensor, lattice=bench.lattice, field=FIELD, noise=CameraNoise(1.0, 8.0)
    )
    return prepare_registration(subimages, settings, FIELD)


def _differ_px(one: Displacement, other: Displacement) -> float:
    assert one.valid.all()
    assert other.valid.all()
    return float(np.abs(one.coefficients - other.coefficients).max())


def test_start_from_previous_frame_gives_same_result(estimate: RegistrationMethod, frames: list[Image]) -> None:
    nowhere = np.zeros(frames[0].shape, np.bool_)
    before = None
    for light in frames:
        warm = estimate(light, saturated=nowhere, start=before)
        assert _differ_px(warm, estimate(light, saturated=nowhere)) < SAME_PX
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
    assert _differ_px(warm, cold) < SAME_PX


def test_start_of_another_warp_is_ignored(small_bench: SmallBench, frames: list[Image]) -> None:
    nowhere = np.zeros(frames[0].shape, np.bool_)
    affine, quadratic = (_prepared(small_bench, RegistrationSettings(warp=warp)) for warp in ("affine", "quadratic"))
    other = affine(frames[0], saturated=nowhere)
    cold = quadratic(frames[0], saturated=nowhere)
    np.testing.assert_array_equal(quadratic(frames[0], saturated=nowhere, start=other).coefficients, cold.coefficients)


@pytest.mark.parametrize("method", ["correlation", "block_flow"])
def test_searching_methods_ignore_start(small_bench: SmallBench, frames: list[Image], method: Method) -> None:
    nowhere = np.zeros(frames[0].shape, np.bool_)
    estimate = _prepared(small_bench, RegistrationSettings(method=method))
    cold = estimate(frames[0], saturated=nowhere)
    far = replace(cold, coefficients=cold.coefficients + 5)
    np.testing.assert_array_equal(estimate(frames[0], saturated=nowhere, start=far).coefficients, cold.coefficients)
