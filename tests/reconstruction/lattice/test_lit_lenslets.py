"""Survey of any set of lit lenslets: turned arrays, round pupils, cells that the frame cuts, unequal pitches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from support.lattice_frames import FRAME, SENSOR, drawn, sensor_with
from support.spot_frames import SIDE_PX, hexagonal_centers_px, near, spots, square_centers_px

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Arrangement, Lattice, Sensor
from reconstruction.lattice.search import Survey, survey

EDGE_PX = 6.5  # from the frame's edge, a spot of 2.2 px lies on the frame whole


def sensor(arrangement: Arrangement = "square", rows: int | None = None, columns: int | None = None) -> Sensor:
    """A sensor of 30 px, its rows and columns omitted."""
    return replace(sensor_with(9, 9, 30.0), arrangement=arrangement, lenslet_rows=rows, lenslet_columns=columns)


def lit_px(found: Survey) -> Floats:
    """Camera positions of the lit lenslets, (N, xy)."""
    return found.lattice.lenslet_centers_px(*found.illuminated.shape)[found.illuminated]


@pytest.mark.parametrize("angle_deg", range(0, 61, 5))
def test_turned_hexagonal_array_in_a_round_pupil_is_found_whole(angle_deg: int) -> None:
    centers_px = hexagonal_centers_px(angle_deg=angle_deg)
    found = survey(spots(centers_px), sensor("hexagonal"))
    assert (len(centers_px), found.illuminated.sum()) == (163, 163)
    assert near(lit_px(found), centers_px).max() < 0.1
    assert found.lattice.pitch_px == pytest.approx(30, abs=0.01)
    assert found.illuminated.any(axis=0).all()  # no row or column in vain but one, so that the first row is even
    assert found.illuminated[1:].any(axis=1).all()


@pytest.mark.parametrize(("rows", "columns"), [(20, 20), (16, 15), (12, 12)])
def test_given_rows_and_columns_hold_as_many_lit_lenslets_as_they_can(rows: int, columns: int) -> None:
    centers_px = hexagonal_centers_px(angle_deg=30)
    found = survey(spots(centers_px), sensor("hexagonal", rows, columns))
    assert found.illuminated.shape == (rows, columns)
    assert found.illuminated.sum() >= (163 if rows > 12 else 119)
    assert near(lit_px(found), centers_px).max() < 0.1


def test_block_holds_every_lit_lenslet_if_it_can() -> None:
    """Also a single one in its row, although the next block of as many rows lies nearer to the frame's middle."""
    brightness = np.zeros((15, 15))
    brightness[1:11, 1:12] = brightness[0, 6] = 1
    found = survey(drawn(brightness=brightness), sensor_with(12, 13, 31.25))
    assert found.illuminated.sum() == brightness.sum()


@pytest.mark.parametrize("angle_deg", [0, 17, 45])
def test_square_array_that_fills_the_frame_is_found_up_to_its_edge(angle_deg: float) -> None:
    centers_px = square_centers_px(angle_deg=angle_deg)
    found = survey(spots(centers_px), sensor())
    whole = np.all((centers_px > EDGE_PX) & (centers_px < SIDE_PX - 1 - EDGE_PX), axis=1)
    visible = np.all((centers_px > -1) & (centers_px < SIDE_PX), axis=1)
    assert near(lit_px(found), centers_px).max() < 0.1
    assert near(centers_px[whole], lit_px(found)).max() < 0.1
    assert near(lit_px(found), centers_px[visible]).max() < 0.1


def test_central_obscuration_and_spiders_leave_absent_lenslets() -> None:
    centers_px = hexagonal_centers_px(angle_deg=12)
    x, y = (centers_px - (SIDE_PX - 1) / 2).T
    lit = (np.hypot(x, y) > 70) & (np.abs(x) > 8)
    found = survey(spots(centers_px[lit]), sensor("hexagonal"))
    assert found.illuminated.sum() == lit.sum()
    assert near(lit_px(found), centers_px[lit]).max() < 0.1


@pytest.mark.parametrize("wide", [1, 2])
def test_spiders_shadow_does_not_end_the_lattice(wide: int) -> None:
    """A cross of whole rows and columns: a quarter of the pupil was taken for all of it."""
    brightness = np.ones((13, 13))
    brightness[6 : 6 + wide] = brightness[:, 6 : 6 + wide] = 0
    found = survey(
        drawn(brightness=brightness), replace(sensor_with(9, 9, 31.25), lenslet_rows=None, lenslet_columns=None)
    )
    assert found.illuminated.shape == (13, 13)
    assert found.illuminated.sum() == brightness.sum()


@pytest.mark.parametrize("angle_deg", [0.0, 11.0])
def test_pitches_that_differ_along_x_and_y_are_found(angle_deg: float) -> None:
    truth_px = square_centers_px(angle_deg=angle_deg, pitch_px=(29.2, 27.8))
    centers_px = truth_px[np.hypot(*(truth_px - (SIDE_PX - 1) / 2).T) < 210]
    found = survey(spots(centers_px), sensor())
    assert np.linalg.eigvalsh(found.lattice.pitch_matrix_px) == pytest.approx((27.8, 29.2), abs=0.02)
    assert found.lattice.pitch_text(1) == "27.8 x 29.2 px"
    assert found.illuminated.sum() == len(centers_px)
    assert near(lit_px(found), centers_px).max() < 0.1
    assert found.residual_px < 0.1


@pytest.mark.parametrize("stretched_deg", [0, 40, 90])
def test_pitch_that_depends_on_any_direction_is_found(stretched_deg: float) -> None:
    """A turned hexagonal array whose pitch is 5 % larger along one direction of the camera than across it."""
    middle, along = (SIDE_PX - 1) / 2, np.exp(1j * np.radians(stretched_deg))
    place = (hexagonal_centers_px(angle_deg=30) - middle) @ [1, 1j] / along
    place = (1.025 * place.real + 0.975j * place.imag) * along
    centers_px = np.stack([place.real, place.imag], axis=-1) + middle
    found = survey(spots(centers_px), sensor("hexagonal"))
    assert np.linalg.eigvalsh(found.lattice.pitch_matrix_px) == pytest.approx((29.25, 30.75), abs=0.01)
    assert found.illuminated.sum() == len(centers_px)
    assert near(lit_px(found), centers_px).max() < 0.05


def test_equal_pitches_stay_one() -> None:
    assert survey(drawn(), SENSOR).lattice.stretch is None


def test_lattice_cut_by_the_frame_has_absent_columns() -> None:
    truth = Lattice(center_x_px=300, center_y_px=255, pitch_px=31)
    found = survey(drawn(lattice=truth), SENSOR)
    assert found.illuminated.shape == (15, 15)
    assert (found.rows, found.columns) == (15, 14)
    assert found.illuminated.sum() == 15 * 14


def test_few_lit_lenslets_are_refused_with_the_numbers_compared() -> None:
    with pytest.raises(
        ReconstructionError, match=r"only 25 of its lenslets have light, not 28 in several rows.*: omit sensor"
    ):
        survey(drawn(brightness=np.pad(np.ones((5, 5)), 5)), SENSOR)


def test_speckle_is_not_asked_whether_the_light_was_on() -> None:
    rng = np.random.default_rng(0)
    field = ndimage.gaussian_filter(rng.normal(size=FRAME), 3) + 1j * ndimage.gaussian_filter(rng.normal(size=FRAME), 3)
    intensity = np.abs(field) ** 2
    with pytest.raises(ReconstructionError, match="its light does not repeat: is the lenslet array in the beam"):
        survey(rng.poisson(100 + 1000 * intensity / intensity.mean()), SENSOR)


def test_images_far_from_the_lattice_are_refused_with_the_remedy() -> None:
    centers_px = hexagonal_centers_px(angle_deg=30)
    away_px = np.random.default_rng(1).normal(0, 3.2, centers_px.shape)
    with pytest.raises(
        ReconstructionError, match=r"from a hexagonal lattice by \d+ % of the pitch, .*: set \[lattice\]"
    ):
        survey(spots(centers_px + away_px), sensor("hexagonal"))
