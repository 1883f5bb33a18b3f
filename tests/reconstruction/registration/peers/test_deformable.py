"""Demons and free-form deformation: known displacements through the forward model and back."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest
from support.optics import FIELD, FLOW_MODES, VIEWS, SmallBench, at_views

from reconstruction.arrays import Image
from reconstruction.displacement import Outcome
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import FieldModes, SampledModes
from reconstruction.registration.peers.deformable import Demons, FreeForm
from reconstruction.registration.peers.itk_affine import ItkAffine
from reconstruction.registration.subimages import ReferenceSubimages

ROWS, COLUMNS = 2, 3


@pytest.fixture(scope="module")
def bench() -> SmallBench:
    return SmallBench(ROWS, COLUMNS)


@pytest.fixture(scope="module")
def reference(bench: SmallBench) -> ReferenceSubimages:
    return bench.subimages()


@pytest.mark.parametrize("method", [Demons, FreeForm])
@pytest.mark.parametrize("modes", FLOW_MODES.values(), ids=FLOW_MODES)
@pytest.mark.parametrize(("tilt", "growth", "figure_px"), [(3000.0, 0.0, 0.15), (-6000.0, 2000.0, 0.2)])
def test_known_displacements_come_back(  # noqa: PLR0917 - parameters come by name
    bench: SmallBench,
    reference: ReferenceSubimages,
    method: type[Demons | FreeForm],
    modes: FieldModes,
    tilt: float,
    growth: float,
    figure_px: float,
) -> None:
    frame, expected_px = bench.tilted(tilt, growth)
    displacement = method(reference, modes)(frame, saturated=np.zeros(frame.shape, np.bool_))
    assert displacement.valid.all()
    error_px = at_views(displacement) - expected_px
    assert np.abs(error_px).max() < figure_px
    assert np.all(displacement.variance > 0)


@pytest.mark.parametrize(
    ("method", "bend", "figure"),
    [(Demons, lambda x, y: x * y, 0.9), (FreeForm, lambda _x, y: y**2, 0.4)],  # each what its edges show best
)
def test_a_bend_is_followed_beyond_the_affine_start(
    bench: SmallBench,
    reference: ReferenceSubimages,
    method: type[Demons | FreeForm],
    bend: Callable[[float, float], float],
    figure: float,
) -> None:
    u, v = bench.samples()
    half_m = FIELD.half_width_m
    frame = bench.frame(lambda x, y: (4000.0 * bend(x / half_m, y / half_m) * u + 0 * v).astype(np.float32))
    expected = np.array([[4000.0 * bend(x, y) for x in VIEWS] for y in VIEWS]) / bench.sensor.slope_per_px
    errors = []
    for estimator in (ItkAffine(reference), method(reference, FLOW_MODES["views"])):
        displacement = estimator(frame, saturated=np.zeros(frame.shape, np.bool_))
        errors.append(np.sqrt(np.mean((at_views(displacement)[..., 0] - expected) ** 2)))
    assert errors[1] < figure * errors[0]


@pytest.mark.parametrize("method", [Demons, FreeForm])
def test_dark_and_saturated_lenslets_are_lost(
    bench: SmallBench, reference: ReferenceSubimages, method: type[Demons | FreeForm]
) -> None:
    frame: Image = bench.reference.copy()
    center = np.rint(bench.lattice.lenslet_centers_px(ROWS, COLUMNS)).astype(int)
    x, y = center[0, 0]
    frame[y - 15 : y + 16, x - 15 : x + 16] = 0
    saturated = np.zeros(frame.shape, np.bool_)
    saturated[center[1, 2, 1], center[1, 2, 0]] = True
    displacement = method(reference, FLOW_MODES["views"])(frame, saturated=saturated)
    expected = np.zeros((ROWS, COLUMNS))
    expected[0, 0], expected[1, 2] = Outcome.DARK, Outcome.SATURATED
    np.testing.assert_array_equal(displacement.outcome, expected)
    np.testing.assert_array_equal(np.isnan(displacement.coefficients[..., 0, 0]), expected != 0)


@pytest.mark.parametrize("method", [Demons, FreeForm])
def test_a_missing_simple_itk_says_what_to_install(
    reference: ReferenceSubimages, monkeypatch: pytest.MonkeyPatch, method: type[Demons | FreeForm]
) -> None:
    monkeypatch.setitem(sys.modules, "SimpleITK", None)  # importing it raises ImportError
    with pytest.raises(ReconstructionError, match=r"needs SimpleITK: pip install 'svwfs\[peers\]'"):
        method(reference, FLOW_MODES["views"])


def test_views_beside_the_subimages_are_refused(reference: ReferenceSubimages) -> None:
    with pytest.raises(ReconstructionError, match="views lie beside the subimages"):
        FreeForm(reference, SampledModes(3 * VIEWS, VIEWS))
