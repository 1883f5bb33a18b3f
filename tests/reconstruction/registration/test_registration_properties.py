"""Invariances and robustness of the registration."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.optics import FIELD, SmallBench, sensor_of

from reconstruction.arrays import Image
from reconstruction.displacement import Displacement, RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.geometry import Lattice
from reconstruction.reconstructor import Reconstructor
from reconstruction.registration import prepare_registration
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.runtime.threads import worker_pool
from reconstruction.settings import RegistrationSettings

ROWS, COLUMNS = 4, 5
FEW = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def bench() -> SmallBench:
    return SmallBench(ROWS, COLUMNS)


@pytest.fixture(scope="module")
def frame(bench: SmallBench) -> Image:
    u, v = bench.samples()
    return bench.frame(
        lambda x, y: (1500.0 * u - 900.0 * v + 4e5 * u * x + 2e5 * v * y + 3e8 * u * v * y).astype(np.float32)
    )


def _estimator(bench: SmallBench, reference: Image, lattice: Lattice, **known: Any) -> RegistrationMethod:
    sensor = bench.sensor if reference.shape == bench.frame_shape else sensor_of(COLUMNS, ROWS)
    subimages = ReferenceSubimages(reference, sensor=sensor, lattice=lattice, field=FIELD, **known)
    return prepare_registration(subimages, RegistrationSettings(), FIELD)


def _compare(estimate: RegistrationMethod, light: Image) -> Displacement:
    return estimate(light, saturated=np.zeros(light.shape, np.bool_))


@pytest.fixture(scope="module")
def estimate(bench: SmallBench) -> RegistrationMethod:
    return _estimator(bench, bench.reference, bench.lattice)


@pytest.fixture(scope="module")
def plain(estimate: RegistrationMethod, frame: Image) -> Displacement:
    return _compare(estimate, frame)


def test_busy_worker_threads_change_and_delay_nothing(
    estimate: RegistrationMethod, frame: Image, plain: Displacement
) -> None:
    """The caller fits every lenslet itself; the queued work is cancelled."""
    free = threading.Event()
    busy = worker_pool(RegistrationSettings().threads - 1).submit(free.wait, 60.0)
    try:
        found = _compare(estimate, frame)
        assert not busy.done()
    finally:
        free.set()
    np.testing.assert_array_equal(found.coefficients, plain.coefficients)


@FEW
@given(gain=st.floats(1e-3, 1e3), offset=st.floats(-10.0, 10.0))
def test_gain_and_offset_of_reference_do_not_change_result(
    bench: SmallBench, frame: Image, plain: Displacement, gain: float, offset: float
) -> None:
    reference = np.asarray(gain * (bench.reference + offset * bench.reference.max()), np.float32)
    other = _compare(_estimator(bench, reference, bench.lattice), frame)
    # Flux conservation applies to the offset of the reference as well, hence the tolerance.
    np.testing.assert_allclose(other.mean, plain.mean, atol=0.02 * (1 + abs(offset)))


def _garbage(bench: SmallBench, frame: Image, kind: str, scale: float, seed: int) -> Image:
    rng = np.random.default_rng(seed)
    shape = bench.frame_shape
    peak = float(frame.max())
    images: dict[str, Callable[[], NDArray[Any]]] = {
        "noise": lambda: rng.normal(0, scale, shape),
        "constant": lambda: np.full(shape, scale),
        "negative": lambda: -scale * frame / peak,
        "hot": lambda: np.where(np.arange(np.prod(shape)).reshape(shape) == rng.integers(np.prod(shape)), scale, frame),
        "stripes": lambda: np.broadcast_to(scale * np.sign(np.sin(np.arange(shape[1]) * rng.uniform(0.1, 3))), shape),
        "shuffled": lambda: rng.permuted(frame * (scale / peak), axis=1),
        "blocks": lambda: np.kron(rng.normal(0, scale, (shape[0] // 16 + 1, shape[1] // 16 + 1)), np.ones((16, 16))),
        "huge and tiny": lambda: scale * np.exp(rng.uniform(-20, 0, shape)) * rng.choice([-1, 1], shape),
    }
    return np.asarray(images[kind]()[: shape[0], : shape[1]], np.float32)


KINDS = ("noise", "constant", "negative", "hot", "stripes", "shuffled", "blocks", "huge and tiny")


@settings(FEW, max_examples=80)
@given(kind=st.sampled_from(KINDS), exponent=st.integers(-30, 30), seed=st.integers(0, 1000), known=st.booleans())
def test_any_finite_frame_gives_finite_or_nan_results(  # noqa: PLR0917 - fixtures and draws
    bench: SmallBench,
    frame: Image,
    estimate: RegistrationMethod,
    weighted: RegistrationMethod,
    kind: str,
    exponent: int,
    seed: int,
    known: bool,
) -> None:
    light = _garbage(bench, frame, kind, 10.0**exponent, seed)
    displacement = _compare(weighted if known else estimate, light)
    valid = displacement.valid
    for values in (displacement.coefficients, displacement.covariance, displacement.residual_rms):
        assert np.isfinite(values[valid]).all()
        assert np.isnan(values[~valid]).all()
    assert np.all(displacement.variance[valid] >= 0)
    assert np.all(np.abs(displacement.coefficients[valid]) < 40)
    again = (weighted if known else estimate)(frame, saturated=np.zeros(frame.shape, np.bool_), start=displacement)
    assert again.valid.all()


@pytest.fixture(scope="module")
def weighted(bench: SmallBench) -> RegistrationMethod:
    per_electron = float(bench.reference.max()) / 1000
    return _estimator(
        bench, bench.reference, bench.lattice, noise=KnownNoise(CameraNoise(per_electron, 8 * per_electron))
    )


@pytest.fixture(scope="module")
def reconstructor(bench: SmallBench) -> Reconstructor:
    return bench.reconstructor("quadratic", "zonal")


@settings(FEW, max_examples=40)
@given(kind=st.sampled_from(KINDS), exponent=st.integers(-30, 30), seed=st.integers(0, 1000))
def test_any_finite_frame_is_measured_or_refused(
    bench: SmallBench, frame: Image, reconstructor: Reconstructor, kind: str, exponent: int, seed: int
) -> None:
    try:
        wavefront = reconstructor(_garbage(bench, frame, kind, 10.0**exponent, seed))
    except ReconstructionError:
        return
    assert np.isfinite(wavefront.displacement.coefficients[wavefront.displacement.valid]).all()
