"""The compiled registration against a plain NumPy one."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import FIELD, PAPER, SmallBench, checkerboard
from support.plain_registration import plain_registration

from reconstruction.arrays import Image
from reconstruction.displacement import Displacement
from reconstruction.registration import prepare_registration
from reconstruction.registration.gauss_newton import GaussNewton
from reconstruction.settings import FIELD_MODES, RegistrationSettings, Warp

SAME_PX = 1e-3


BENCHES = {"paper": SmallBench(4, 5, field=PAPER), "real light": SmallBench(4, 5, source=checkerboard())}


def _random_frame(bench: SmallBench, seed: int) -> Image:
    """A frame behind a random wavefront that bends over pupil and field, with noise.

    It moves a checkerboard by less than a cell, so that steps from zero lead there.
    """
    strength = 4 if bench.field.neglect_propagation else 1.5
    rng = np.random.default_rng(seed)
    u, v = (samples / bench.sensor.pupil_half_width_m[0] for samples in bench.samples())
    tilt, bend, turn = rng.normal(0, strength, (3, 2))
    over_field = rng.normal(0, 0.75 * strength, (2, 2))
    half_m = FIELD.half_width_m

    def phase(x_m: float, y_m: float) -> Image:
        x, y = x_m / half_m, y_m / half_m
        phase = tilt[0] * u + tilt[1] * v + bend[0] * u**2 + bend[1] * v**2 + turn[0] * u * v
        phase = phase + (over_field[0, 0] * x + over_field[0, 1] * y) * u + (over_field[1, 0] * x * y) * v * u
        return np.asarray(phase, np.float32)

    frame = bench.frame(phase)
    return np.asarray(frame + rng.normal(0, 0.01 * frame.max(), frame.shape), np.float32)


def _found(bench: SmallBench, frame: Image, warp: Warp, *, threads: int) -> Displacement:
    return _estimate(bench, warp, True, threads)(frame, saturated=np.zeros(frame.shape, np.bool_))


def _estimate(bench: SmallBench, warp: Warp, rotation: bool, threads: int = 2) -> GaussNewton:
    settings = RegistrationSettings(warp=warp, rotation=rotation, threads=threads)
    estimate = prepare_registration(bench.subimages(), settings, bench.field)
    assert isinstance(estimate, GaussNewton)
    return estimate


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("world", "warp", "rotation"),
    [
        ("paper", "affine", True),
        ("paper", "quadratic", True),
        ("paper", "quadratic", False),
        ("paper", "cubic", False),
        ("paper", "quartic", False),
        ("real light", "affine", True),
        ("real light", "quadratic", True),
        ("real light", "cubic", False),
        ("real light", "quartic", False),
    ],
)
def test_compiled_registration_matches_plain_numpy(world: str, warp: Warp, rotation: bool, seed: int) -> None:
    bench = BENCHES[world]
    frame = _random_frame(bench, seed)
    estimate = _estimate(bench, warp, rotation)
    assert estimate.hidden == 0
    plain = plain_registration(
        bench.reference,
        frame,
        sensor=bench.sensor,
        lattice=bench.lattice,
        field=bench.field,
        field_modes=FIELD_MODES[warp],
        offset_px=bench.subimages().offset_px[estimate._warp.images.pixels.ravel()],
        rotation=rotation,
    )
    found = estimate(frame, saturated=np.zeros(frame.shape, np.bool_))
    assert found.valid.all()
    assert np.abs(plain).max() > 0.3
    np.testing.assert_allclose(found.coefficients, plain, atol=SAME_PX)


@pytest.mark.parametrize("threads", [2, 3])
def test_result_does_not_depend_on_threads(threads: int) -> None:
    bench = BENCHES["real light"]
    frame = _random_frame(bench, 3)
    one, more = (_found(bench, frame, "quadratic", threads=count) for count in (1, threads))
    np.testing.assert_array_equal(one.coefficients, more.coefficients)
    np.testing.assert_array_equal(one.covariance, more.covariance)
