"""Lenslets whose cells the frame cuts: measured if their spots lie on it, absent or lost if not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.lattice_frames import sensor_with
from support.optics import SmallBench, at_views
from support.spot_frames import SIDE_PX, spots, square_centers_px

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement, LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, Lattice
from reconstruction.registration import prepare_registration
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings

COUNT = 19  # lenslets a side, of which the outermost lie off the frame
SENSOR = sensor_with(COUNT, COUNT, 30.0)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=1e-4, view_rows=1, view_columns=1)
ANGLE_RAD = 0.15
LATTICE = Lattice(center_x_px=255.5, center_y_px=255.5, pitch_px=30.0, rotation_rad=ANGLE_RAD)
CENTERS_PX = square_centers_px(angle_deg=float(np.degrees(ANGLE_RAD)))


def light(moved_px: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> NDArray[np.float32]:
    """Light of spots all over the frame, moved along the camera's x and y."""
    return spots(CENTERS_PX + moved_px, seed=seed).astype(np.float32) - 100


def subimages(lattice: Lattice = LATTICE) -> ReferenceSubimages:
    return ReferenceSubimages(light(), sensor=SENSOR, lattice=lattice, field=FIELD)


def registered(moved_px: tuple[float, float]) -> Displacement:
    settings = RegistrationSettings(method="centroids", star_rows=1, star_columns=1)
    register = prepare_registration(subimages(), settings, FIELD)
    return register(light(moved_px, seed=1), saturated=np.zeros((SIDE_PX, SIDE_PX), np.bool_))


def from_edge_px(centers_px: Floats) -> Floats:
    """Distance of places (..., xy) from the nearest edge of the frame, inside it, px."""
    return np.asarray(np.minimum(centers_px, SIDE_PX - 1 - centers_px).min(axis=-1))


FROM_EDGE_PX = from_edge_px(LATTICE.lenslet_centers_px(COUNT, COUNT))


def test_lenslets_are_lit_where_their_spots_lie_on_the_frame() -> None:
    lit = subimages().lit.reshape(COUNT, COUNT)
    assert lit[FROM_EDGE_PX > 8].all()
    assert not lit[FROM_EDGE_PX < 2].any()
    assert np.count_nonzero(lit & (FROM_EDGE_PX < 15)) > 10  # cells half a pitch wide that are cut


def test_spots_at_the_edge_are_measured_like_the_others() -> None:
    moved_px = (0.8, -0.6)
    found = registered(moved_px)
    np.testing.assert_array_equal(found.present, subimages().lit.reshape(COUNT, COUNT))
    np.testing.assert_array_equal(found.valid, found.present)
    camera_px = found.mean[found.valid] @ LATTICE.turn
    error_px = np.abs(camera_px - moved_px).max(axis=-1)
    at_edge = FROM_EDGE_PX[found.valid] < 15
    assert np.count_nonzero(at_edge) > 10
    assert error_px[at_edge].max() < max(0.15, 1.5 * error_px[~at_edge].max())


def test_spots_that_move_off_the_frame_are_lost_not_misread() -> None:
    moved_px = (9.0, 0.0)
    found = registered(moved_px)
    after_px = from_edge_px(LATTICE.lenslet_centers_px(COUNT, COUNT) + moved_px)
    gone = found.present & (after_px < 0)
    assert gone.any()
    assert not found.valid[gone].any()
    assert set(found.outcome[gone].tolist()) <= {LensletStatus.LEFT_CELL, LensletStatus.DIVERGED, LensletStatus.DARK}
    camera_px = found.mean[found.valid] @ LATTICE.turn
    assert np.abs(camera_px - moved_px).max() < 0.6
    np.testing.assert_array_equal(found.valid[FROM_EDGE_PX > 15], True)


@pytest.mark.parametrize(("tilt", "error_px"), [(2000.0, 0.005), (-9000.0, 0.02)])
def test_images_of_the_field_at_the_edge_are_warped_like_the_others(
    small_bench: SmallBench, tilt: float, error_px: float
) -> None:
    """The frame cuts 2 px off the first column's cells, and off none of its images until they move by -1.9 px."""
    frame, truth_px = small_bench.tilted(tilt, 800.0)
    cut_px = 20
    lattice = replace(small_bench.lattice, center_x_px=small_bench.lattice.center_x_px - cut_px)
    assert (lattice.lenslet_centers_px(7, 9)[:, 0, 0] < 31.25 / 2 - 2).all()
    reconstruct = small_bench.reconstructor(reference=small_bench.reference[:, cut_px:], lattice=lattice)
    found = reconstruct(frame[:, cut_px:]).displacement
    assert found.valid.all()
    assert np.abs(at_views(found) - truth_px).max() < error_px


def test_absent_lenslets_are_not_counted_as_lost() -> None:
    found = registered((0.5, 0.5))
    present = np.count_nonzero(found.present)
    assert present < COUNT**2
    assert found.summary[0] == f"{present} of {present} lenslets valid"
    assert found.summary[1].startswith(f"{COUNT**2 - present} absent: ")
    assert not any("lost" in sentence for sentence in found.summary)


def test_lattice_of_another_frame_is_refused_with_the_remedy() -> None:
    elsewhere = replace(LATTICE, center_x_px=-20.0, center_y_px=-20.0)
    with pytest.raises(ReconstructionError, match=r"\d+ of 361 lenslets lie outside .* omit sensor\.lenslet_rows"):
        subimages(elsewhere)
