"""The compiled registration against a plain NumPy one."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import FIELD, SmallBench
from support.plain_registration import plain_registration

from reconstruction.arrays import Image
from reconstruction.displacement import Displacement
from reconstruction.registration.methods import prepare_registration
from reconstruction.settings import FIELD_MODES, RegistrationSettings, Warp

SAME_PX = 1e-3


@pytest.fixture(scope="module")
def bench() -> SmallBench:
    return SmallBench(4, 5)


def _random_frame(bench: SmallBench, seed: int) -> Image:
    """A frame behind a random wavefront that bends over pupil and field, with noise."""
    rng = np.random.default_rng(seed)
    u, v = (samples / bench.sensor.pupil_half_width_m[0] for samples in bench.samples())
    tilt, bend, turn = rng.normal(0, 4, (3, 2))
    over_field = rng.normal(0, 3, (2, 2))
    half_m = FIELD.half_width_m

    def phase(x_m: float, y_m: float) -> Image:
        x, y = x_m / half_m, y_m / half_m
        phase = tilt[0] * u + tilt[1] * v + bend[0] * u**2 + bend[1] * v**2 + turn[0] * u * v
        phase = phase + (over_field[0, 0] * x + over_field[0, 1] * y) * u + (over_field[1, 0] * x * y) * v * u
        return np.asarray(phase, np.float32)

    frame = bench.frame(phase)
    return np.asarray(frame + rng.normal(0, 0.01 * frame.max(), frame.shape), np.float32)


def _found(bench: SmallBench, frame: Image, warp: Warp, *, rotation: bool = True, threads: int = 2) -> Displacement:
    settings = RegistrationSettings(warp=warp, rotation=rotation, threads=threads)
    estimate = prepare_registration(bench.subimages(), settings, FIELD)
    return estimate(frame, saturated=np.zeros(frame.shape, np.bool_))


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("warp", "rotation"),
    [(warp, rotation) for warp in ("affine", "quadratic", "cubic") for rotation in (True, False)]
    + [("quartic", False)],
)
def test_compiled_registration_matches_plain_numpy(bench: SmallBench, warp: Warp, rotation: bool, seed: int) -> None:
    frame = _random_frame(bench, seed)
    plain = plain_registration(
        bench.reference,
        frame,
        sensor=bench.sensor,
        lattice=bench.lattice,
        field=FIELD,
        field_modes=FIELD_MODES[warp],
        rotation=rotation,
    )
    found = _found(bench, frame, warp, rotation=rotation)
    assert found.valid.all()
    assert np.abs(plain).max() > 0.3
    np.testing.assert_allclose(found.coefficients, plain, atol=SAME_PX)


@pytest.mark.parametrize("threads", [2, 3])
def test_result_does_not_depend_on_threads(bench: SmallBench, threads: int) -> None:
    frame = _random_frame(bench, 3)
    one, more = (_found(bench, frame, "quadratic", threads=count) for count in (1, threads))
    np.testing.assert_array_equal(one.coefficients, more.coefficients)
    np.testing.assert_array_equal(one.covariance, more.covariance)
