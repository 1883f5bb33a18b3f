"""Warps without rotation: what layers can do to a subimage, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import PAPER, SmallBench

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.settings import RegistrationSettings
from reconstruction.wavefront import rms, without_piston
from simulated_devices.optics.source import source_points
from simulated_devices.settings import Source

_MAGNIFICATION = 0.195 / 0.2  # of the field on a layer 195 mm before the lenslets


def layer(s: Floats, t: Floats) -> Floats:
    """Phase of a layer, rad, at normalised positions; no polynomial that the estimator fits exactly."""
    return np.asarray(2.5 * np.sin(1.7 * s + 0.4) * np.cos(1.3 * t) + 1.5 * s * t - 1.2 * t**3 + 0.8 * s**2)


class RoundBench(SmallBench):
    """The small bench with a disc as its source, behind one layer."""

    def __init__(self) -> None:
        super().__init__(5, 7, field=PAPER)
        self.source = source_points("circle", Source(), object_samples=19)
        self.reference = self.model.irradiance(self.source) * 1e14
        self.scale_m = max(self.sensor.pupil_half_width_m) + 0.6e-3

    def seen(self, u_m: Floats, v_m: Floats, x_m: float, y_m: float) -> Floats:
        """Phase that the field position (x, y) sees at the pupil positions (u, v)."""
        return layer((u_m + _MAGNIFICATION * x_m) / self.scale_m, (v_m + _MAGNIFICATION * y_m) / self.scale_m)

    def measured(self, *, rotation: bool) -> tuple[float, Displacement]:
        """Residual of the views inside the disc, rad, and the displacement."""
        u, v = self.samples()
        frame = self.frame(lambda x, y: self.seen(u, v, x, y).astype(np.float32))
        registration = RegistrationSettings(warp="quadratic", rotation=rotation)
        wavefront = self.reconstructor(pupil_modes=None, registration=registration)(frame)
        residuals = [
            rms(wavefront.at(x, y) - without_piston(self.seen(self.pupil_x_m, self.pupil_y_m, x, y)))
            for x, y in ((0.0, 0.0), (4e-4, 0.0), (-4e-4, 0.0), (0.0, 4e-4), (0.0, -4e-4))
        ]
        return float(np.mean(residuals)), wavefront.displacement


@pytest.fixture(scope="module")
def bench() -> RoundBench:
    return RoundBench()


def circulation(displacement: Displacement) -> Floats:
    """Curl of every lenslet's displacement at points of the field, px per half width, (row, column, point)."""
    x, y = np.random.default_rng(0).uniform(-0.9, 0.9, (2, 20))
    slopes = displacement.modes.gradients(x, y)  # type: ignore[union-attr] # Legendre
    c = displacement.coefficients
    return np.asarray(c[..., 1] @ slopes[..., 0] - c[..., 0] @ slopes[..., 1])


def test_round_source_is_as_good_as_a_square_one_without_rotation(bench: RoundBench) -> None:
    with_rotation, free = bench.measured(rotation=True)
    without, bound = bench.measured(rotation=False)
    assert bound.valid.all()
    assert without < 0.025
    assert without < 0.7 * with_rotation < 0.03  # of the rotation, what the disc hides is left out
    assert np.abs(circulation(bound)).max() < 1e-5
    assert np.abs(circulation(free)).max() > 1e-2


def test_covariance_has_no_rotation_either(bench: RoundBench) -> None:
    _, displacement = bench.measured(rotation=False)
    covariance = displacement.covariance[2, 3]  # (field_mode, xy, field_mode, xy)
    turn = np.zeros((6, 2))
    turn[1, 1], turn[2, 0] = 1.0, -1.0  # (-y, x)
    variance = np.einsum("qd,qdre,re", turn, covariance, turn)
    assert abs(variance) < 1e-9 * np.einsum("qdqd", covariance)
