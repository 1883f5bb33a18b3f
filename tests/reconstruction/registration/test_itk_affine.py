"""SimpleITK's affine registration: known displacements through the forward model and back."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from support.optics import FIELD, SmallBench

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.registration.itk_affine import ItkAffine
from reconstruction.registration.subimages import ReferenceSubimages

ROWS, COLUMNS = 3, 4


@pytest.fixture(scope="module")
def bench() -> SmallBench:
    return SmallBench(ROWS, COLUMNS)


@pytest.fixture(scope="module")
def reference(bench: SmallBench) -> ReferenceSubimages:
    return bench.subimages()


def rendered(bench: SmallBench, tilt: tuple[float, float], growth: tuple[float, float]) -> tuple[Image, Floats]:
    """A frame of the slopes, rad/m, tilt (x, y) plus growth (x, y) times the field's x; its c_q, px, (3, xy)."""
    u, v = bench.samples()
    half_m = FIELD.half_width_m

    def phase(x: float, _y: float) -> Image:
        along_x, along_y = (t + g * x / half_m for t, g in zip(tilt, growth, strict=True))
        return (along_x * u + along_y * v).astype(np.float32)

    return bench.frame(phase), np.array([tilt, growth, (0.0, 0.0)]) / bench.sensor.slope_per_px


def unsaturated(light: Image) -> Booleans:
    return np.zeros(light.shape, np.bool_)


# Without flux the affine map finds only four fifths of a stretch of 0.43 px: it takes thinner light for motion.
@pytest.mark.parametrize(
    ("tilt", "growth", "limit_px"),
    [((3000.0, 1000.0), (0.0, 0.0), 0.01), ((-6000.0, 9000.0), (0.0, 0.0), 0.01), ((0.0, 0.0), (2000.0, 1500.0), 0.1)],
)
def test_affine_map_recovers_known_displacements(
    bench: SmallBench,
    reference: ReferenceSubimages,
    tilt: tuple[float, float],
    growth: tuple[float, float],
    limit_px: float,
) -> None:
    frame, expected = rendered(bench, tilt, growth)
    displacement = ItkAffine(reference)(frame, saturated=unsaturated(frame))
    assert displacement.valid.all()
    assert displacement.coefficients.shape == (ROWS, COLUMNS, 3, 2)
    assert np.abs(displacement.coefficients - expected).max() < limit_px
    assert np.all((displacement.variance > 0) & (displacement.variance < 0.05**2))


def test_affine_map_loses_dark_saturated_and_foreign_lenslets(bench: SmallBench, reference: ReferenceSubimages) -> None:
    frame, _ = rendered(bench, (1000.0, 0.0), (0.0, 0.0))
    center = np.rint(bench.lattice.lenslet_centers_px(ROWS, COLUMNS)).astype(int)
    cells = [(0, 0), (2, 3)]
    for index, (row, column) in enumerate(cells):
        x, y = center[row, column]
        window = frame[y - 15 : y + 16, x - 15 : x + 16]
        window[:] = np.random.default_rng(1).uniform(0, frame.max(), window.shape) if index else 0
    saturated = unsaturated(frame)
    saturated[center[1, 2, 1], center[1, 2, 0]] = True
    displacement = ItkAffine(reference)(frame, saturated=saturated)
    expected = np.zeros((ROWS, COLUMNS))
    expected[0, 0], expected[2, 3], expected[1, 2] = LensletStatus.DARK, LensletStatus.DIVERGED, LensletStatus.SATURATED
    np.testing.assert_array_equal(displacement.outcome, expected)
    for values in (displacement.coefficients, displacement.variance, displacement.residual_rms):
        np.testing.assert_array_equal(np.isnan(values.reshape(ROWS, COLUMNS, -1)).any(axis=2), expected != 0)


def test_missing_simple_itk_names_the_package_to_install(
    reference: ReferenceSubimages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "SimpleITK", None)  # importing it raises ImportError
    with pytest.raises(ReconstructionError, match=r"needs SimpleITK: pip install 'svwfs\[peers\]'"):
        ItkAffine(reference)
