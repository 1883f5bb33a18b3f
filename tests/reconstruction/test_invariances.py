"""Invariance to transposition, gain, offset and shift of the lattice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.optics import SmallBench, sensor_of

from reconstruction.geometry import Lattice
from reconstruction.settings import FIELD_MODES

METHODS = [("modal", 21), ("modal", None), ("zonal", None)]


@pytest.fixture(scope="module")
def frame(checker_bench: SmallBench) -> NDArray[np.float32]:
    u, v = (axis / 2e-3 for axis in checker_bench.samples())
    return checker_bench.frame(
        lambda x, y: (3 * u**2 - 2 * u * v + 4 * v + 1500 * x * u + 2000 * y * (u**2 - v)).astype(np.float32)
    )


@pytest.mark.parametrize(("method", "pupil_modes"), METHODS)
@pytest.mark.parametrize("warp", FIELD_MODES)
def test_transposed_frame_gives_transposed_wavefront(
    checker_bench: SmallBench, frame: NDArray[np.float32], warp: str, method: str, pupil_modes: int | None
) -> None:
    upright = checker_bench.reconstructor(warp, method, pupil_modes)(frame)
    lattice = checker_bench.lattice
    across = Lattice(
        center_x_px=lattice.center_y_px,
        center_y_px=lattice.center_x_px,
        pitch_px=lattice.pitch_px,
        rotation_rad=-lattice.rotation_rad,
    )
    transposed = checker_bench.reconstructor(
        warp, method, pupil_modes, reference=checker_bench.reference.T, sensor=sensor_of(9, 7), lattice=across
    )(np.ascontiguousarray(frame.T))
    np.testing.assert_allclose(transposed.views.transpose(1, 0, 3, 2), upright.views, atol=5e-3)
    np.testing.assert_allclose(transposed.sigma().transpose(1, 0, 3, 2), upright.sigma(), rtol=0.1, atol=1e-4)


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(gain=st.floats(0.05, 20), offset=st.floats(-0.5, 0.5))
@pytest.mark.parametrize(("method", "pupil_modes"), METHODS)
def test_gain_and_offset_do_not_change_result(
    checker_bench: SmallBench,
    frame: NDArray[np.float32],
    method: str,
    pupil_modes: int | None,
    gain: float,
    offset: float,
) -> None:
    reconstructor = checker_bench.reconstructor("quadratic", method, pupil_modes)
    other = reconstructor((gain * (frame + offset * frame.max())).astype(np.float32))
    np.testing.assert_allclose(other.views, reconstructor(frame).views, atol=5e-3)


@pytest.mark.parametrize("shift", [(1, 0), (0, 1), (2, 3)])
def test_moving_lattice_and_image_does_not_change_wavefront(
    checker_bench: SmallBench, frame: NDArray[np.float32], shift: tuple[int, int]
) -> None:
    lattice = checker_bench.lattice
    moved = replace(lattice, center_x_px=lattice.center_x_px + shift[1], center_y_px=lattice.center_y_px + shift[0])
    reference, image = (np.pad(each, ((shift[0], 0), (shift[1], 0))) for each in (checker_bench.reference, frame))
    found = checker_bench.reconstructor("quadratic", "modal", None, reference=reference, lattice=moved)(image)
    expected = checker_bench.reconstructor("quadratic", "modal", None)(frame)
    np.testing.assert_allclose(found.views, expected.views, atol=1e-3)
