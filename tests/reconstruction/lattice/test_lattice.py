"""Lattice search in rendered references."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import FIELD, SmallBench, sensor_of

from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import survey
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.source import source_points, stars
from simulated_devices.settings import Source


@pytest.mark.parametrize("rotation_rad", [-0.015, 0.0, 0.008])
@pytest.mark.parametrize("source", ["square", "stars"])
def test_pitch_rotation_and_centre_are_found(rotation_rad: float, source: str) -> None:
    lattice = Lattice(center_x_px=161.7, center_y_px=129.2, pitch_px=31.4, rotation_rad=rotation_rad)
    model = ForwardModel(
        sensor_of(7, 9), lattice, FIELD, shape=(264, 330), pupil_samples=12, pixel_fill_factor=1.0, border_lenslets=0
    )
    points = source_points("square", Source(), object_samples=19) if source == "square" else stars(Source())
    reference = model.irradiance(points) * 1e12
    reference += np.random.default_rng(0).normal(200, 0.02 * reference.max(), reference.shape).astype(np.float32)
    found = survey(reference, sensor_of(7, 9)).lattice
    assert (found.center_x_px, found.center_y_px) == pytest.approx((161.7, 129.2), abs=0.1)
    assert found.pitch_px == pytest.approx(31.4, abs=0.02)
    assert found.rotation_rad == pytest.approx(rotation_rad, abs=5e-4)


def test_even_lattice_is_centred_between_lenslets(small_bench: SmallBench) -> None:
    found = survey(small_bench.reference, sensor_of(6, 8)).lattice
    centers = small_bench.lattice.lenslet_centers_px(7, 9).reshape(-1, 2)
    first = found.lenslet_centers_px(6, 8)[0, 0]
    assert np.hypot(*(centers - first).T).min() < 0.1


@pytest.mark.parametrize("make", [np.zeros, np.ones, lambda shape: np.random.default_rng(0).normal(500, 8, shape)])
def test_frame_without_lattice_is_refused(make: object) -> None:
    with pytest.raises(ReconstructionError, match="no lattice"):
        survey(make((300, 400)), sensor_of(7, 9))  # type: ignore[operator] # one of three functions


def test_too_small_frame_is_refused() -> None:
    with pytest.raises(ReconstructionError, match=r"not even 2 x 2 lenslets of 31\.3 px fit on 100 x 40 pixels"):
        survey(np.ones((100, 40)), sensor_of(7, 9))
