"""Block-wise optical flow: known displacements through the forward model and back."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import FLOW_MODES, VIEWS, SmallBench, at_views

from reconstruction.arrays import Image
from reconstruction.displacement import Outcome
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import FieldModes, SampledModes
from reconstruction.registration.peers.block_flow import BlockFlow
from reconstruction.registration.subimages import ReferenceSubimages

ROWS, COLUMNS = 2, 3


@pytest.fixture(scope="module")
def bench() -> SmallBench:
    return SmallBench(ROWS, COLUMNS)


@pytest.fixture(scope="module")
def reference(bench: SmallBench) -> ReferenceSubimages:
    return bench.subimages()


# Blocks of a blurred square find their shift to a quarter of a pixel, their mean over the field better.
@pytest.mark.parametrize("modes", FLOW_MODES.values(), ids=FLOW_MODES)
@pytest.mark.parametrize(("tilt", "growth", "figure_px"), [(3000.0, 0.0, 0.3), (-6000.0, 2000.0, 0.3)])
def test_known_displacements_come_back(
    bench: SmallBench,
    reference: ReferenceSubimages,
    modes: FieldModes,
    tilt: float,
    growth: float,
    figure_px: float,
) -> None:
    frame, expected_px = bench.tilted(tilt, growth)
    displacement = BlockFlow(reference, modes)(frame, saturated=np.zeros(frame.shape, np.bool_))
    assert displacement.valid.all()
    error_px = at_views(displacement) - expected_px
    assert np.abs(error_px).max() < figure_px
    assert np.abs(error_px.mean(axis=(2, 3))).max() < figure_px / 2
    assert np.all(displacement.variance > 0)


def test_dark_and_saturated_lenslets_are_lost(bench: SmallBench, reference: ReferenceSubimages) -> None:
    frame: Image = bench.reference.copy()
    center = np.rint(bench.lattice.lenslet_centers_px(ROWS, COLUMNS)).astype(int)
    x, y = center[0, 0]
    frame[y - 15 : y + 16, x - 15 : x + 16] = 0
    saturated = np.zeros(frame.shape, np.bool_)
    saturated[center[1, 2, 1], center[1, 2, 0]] = True
    displacement = BlockFlow(reference, FLOW_MODES["views"])(frame, saturated=saturated)
    expected = np.zeros((ROWS, COLUMNS))
    expected[0, 0], expected[1, 2] = Outcome.DARK, Outcome.SATURATED
    np.testing.assert_array_equal(displacement.outcome, expected)
    np.testing.assert_array_equal(np.isnan(displacement.coefficients[..., 0, 0]), expected != 0)


def test_views_beside_the_subimages_are_refused(reference: ReferenceSubimages) -> None:
    with pytest.raises(ReconstructionError, match="views lie beside the subimages"):
        BlockFlow(reference, SampledModes(3 * VIEWS, VIEWS))
