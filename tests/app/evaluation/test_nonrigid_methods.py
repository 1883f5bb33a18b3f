"""Non-rigid methods of the paper: known displacements through the forward model and back, faults, reconstruction."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest
from support.optics import FIELD, VIEWS, SmallBench, at_views

from app.evaluation.paper.nonrigid_methods import BlockFlow, Demons, FreeForm
from reconstruction.arrays import Image
from reconstruction.displacement import LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise
from reconstruction.reconstructor import OwnMethods
from reconstruction.registration.itk_affine import ItkAffine
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings

ROWS, COLUMNS = 2, 3
FlowMethod = type[BlockFlow | Demons | FreeForm]
ALL = pytest.mark.parametrize("method", [BlockFlow, Demons, FreeForm])


@pytest.fixture(scope="module")
def bench() -> SmallBench:
    return SmallBench(ROWS, COLUMNS)


@pytest.fixture(scope="module")
def reference(bench: SmallBench) -> ReferenceSubimages:
    return bench.subimages()


@ALL
@pytest.mark.parametrize(("tilt", "growth", "limit_px"), [(3000.0, 0.0, 0.15), (-6000.0, 2000.0, 0.2)])
def test_known_displacements_are_recovered(
    bench: SmallBench, reference: ReferenceSubimages, method: FlowMethod, tilt: float, growth: float, limit_px: float
) -> None:
    if method is BlockFlow:  # a blurred square's blocks are accurate to a quarter of a pixel, their mean is better
        limit_px = 0.3
    frame, expected_px = bench.tilted(tilt, growth)
    displacement = method(reference, FIELD)(frame, saturated=np.zeros(frame.shape, np.bool_))
    assert displacement.valid.all()
    error_px = at_views(displacement) - expected_px
    assert np.abs(error_px).max() < limit_px
    assert np.abs(error_px.mean(axis=(2, 3))).max() < 0.15
    assert np.all(displacement.variance > 0)


@ALL
def test_dark_and_saturated_lenslets_are_lost(
    bench: SmallBench, reference: ReferenceSubimages, method: FlowMethod
) -> None:
    frame: Image = bench.reference.copy()
    center = np.rint(bench.lattice.lenslet_centers_px(ROWS, COLUMNS)).astype(int)
    x, y = center[0, 0]
    frame[y - 15 : y + 16, x - 15 : x + 16] = 0
    saturated = np.zeros(frame.shape, np.bool_)
    saturated[center[1, 2, 1], center[1, 2, 0]] = True
    displacement = method(reference, FIELD)(frame, saturated=saturated)
    expected = np.zeros((ROWS, COLUMNS))
    expected[0, 0], expected[1, 2] = LensletStatus.DARK, LensletStatus.SATURATED
    np.testing.assert_array_equal(displacement.outcome, expected)
    np.testing.assert_array_equal(np.isnan(displacement.coefficients[..., 0, 0]), expected != 0)


def test_dead_pixels_are_tolerated(bench: SmallBench) -> None:
    frame, _ = bench.tilted(3000.0, 0.0)
    bad = np.zeros(frame.shape, np.bool_)
    bad[tuple(np.rint(bench.lattice.lenslet_centers_px(ROWS, COLUMNS)).astype(int).reshape(-1, 2).T[::-1])] = True
    found = []
    for dead in (np.zeros_like(bad), bad):
        reference, light = (np.where(dead, 0, image).astype(np.float32) for image in (bench.reference, frame))
        windows = ReferenceSubimages(reference, sensor=bench.sensor, lattice=bench.lattice, field=FIELD, bad=dead)
        found.append(BlockFlow(windows, FIELD)(light, saturated=np.zeros(frame.shape, np.bool_)))
    assert found[1].valid.all()
    np.testing.assert_allclose(found[1].mean, found[0].mean, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("method", [BlockFlow, Demons])
@pytest.mark.parametrize("integrate", ["modal", "zonal"])
def test_wavefront_is_reconstructed_with_known_noise_and_an_excluded_lenslet(
    small_bench: SmallBench, method: FlowMethod, integrate: str
) -> None:
    per_electron = float(small_bench.reference.max()) / 1e4
    frame, _ = small_bench.tilted(3000.0, 0.0)
    wavefront = small_bench.reconstructor(
        method=integrate,
        registration=RegistrationSettings(excluded=((2, 5),)),
        own=OwnMethods(method),
        noise=CameraNoise(per_electron, 8 * per_electron),
    )(frame)
    assert np.argwhere(~wavefront.displacement.valid).tolist() == [[2, 5]]
    assert wavefront.displacement.outcome[2, 5] == LensletStatus.EXCLUDED
    assert np.isfinite(wavefront.views).any()


@pytest.mark.parametrize(
    ("method", "bend", "limit"),
    [(Demons, lambda x, y: x * y, 0.9), (FreeForm, lambda _x, y: y**2, 0.4)],  # the bends that each follows best
)
def test_non_rigid_methods_follow_a_bend_beyond_the_affine_map(
    bench: SmallBench,
    reference: ReferenceSubimages,
    method: type[Demons | FreeForm],
    bend: Callable[[float, float], float],
    limit: float,
) -> None:
    u, v = bench.samples()
    half_m = FIELD.half_width_m
    frame = bench.frame(lambda x, y: (4000.0 * bend(x / half_m, y / half_m) * u + 0 * v).astype(np.float32))
    expected = np.array([[4000.0 * bend(x, y) for x in VIEWS] for y in VIEWS]) / bench.sensor.slope_per_px
    errors = []
    for register in (ItkAffine(reference), method(reference, FIELD)):
        displacement = register(frame, saturated=np.zeros(frame.shape, np.bool_))
        errors.append(np.sqrt(np.mean((at_views(displacement)[..., 0] - expected) ** 2)))
    assert errors[1] < limit * errors[0]


def test_missing_simple_itk_names_the_package_to_install(
    reference: ReferenceSubimages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "SimpleITK", None)  # importing it raises ImportError
    with pytest.raises(ReconstructionError, match=r"needs SimpleITK: pip install 'svwfs\[peers\]'"):
        Demons(reference, FIELD)
