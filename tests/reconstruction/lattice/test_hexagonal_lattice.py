"""Survey of hexagonal lattices in closed-form frames, and refusal of the other arrangement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.lattice_frames import FRAME, Shape, draw, drawn, image_of, photographed, sensor_with

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.frame.spline import spline_coefficients
from reconstruction.geometry import Lattice, Sensor
from reconstruction.lattice._fit import least_rotation_rad
from reconstruction.lattice.cells import cut
from reconstruction.lattice.search import survey

CENTER_PX, PITCH_PX, BLUR_PX = (257.3, 251.8), 31.4, 1.2


def sensor(rows: int, columns: int) -> Sensor:
    return replace(sensor_with(rows, columns, 31.25), arrangement="hexagonal")


def centers_px(rows: int, columns: int, rotation_rad: float) -> Floats:
    """Centres (lenslet_row, lenslet_column, xy) of odd rows half a pitch to the right, written out."""
    row, column = np.indices((rows, columns))
    x = column - (columns - 1) / 2 + np.where(row % 2, 0.25, -0.25)
    y = (row - (rows - 1) / 2) * np.sqrt(3) / 2
    turned = (x + 1j * y) * np.exp(1j * rotation_rad) * PITCH_PX
    return np.stack([turned.real + CENTER_PX[0], turned.imag + CENTER_PX[1]], axis=-1)


def hexagons(
    brightness: Floats,
    *,
    shape: Shape = "square",
    half_width: float = 0.25,
    rotation_rad: float = 0.0,
    moved_px: tuple[float, float] = (0.0, 0.0),
) -> Floats:
    rows, columns = brightness.shape
    row, _ = np.indices((rows, columns))
    beside = np.stack([np.where(row % 2, 0.25, -0.25), (row - (rows - 1) / 2) * (np.sqrt(3) / 2 - 1)], axis=-1)
    return draw(
        FRAME,
        center_px=(CENTER_PX[0] + moved_px[0], CENTER_PX[1] + moved_px[1]),
        pitch_px=PITCH_PX,
        rotation_rad=rotation_rad,
        brightness=brightness,
        image_px=image_of(shape, PITCH_PX, half_width, BLUR_PX),
        beside_px=beside * PITCH_PX,
    )


@pytest.mark.parametrize(
    ("shape", "rotation_rad"),
    [("square", 0.017), ("square", np.pi / 6), ("disc", -0.2), ("pinhole", 0.0), ("stars", 0.7)],
)
def test_lattice_is_found_at_any_rotation(shape: Shape, rotation_rad: float) -> None:
    light = hexagons(np.ones((11, 10)), shape=shape, rotation_rad=rotation_rad)
    found = survey(photographed(light, np.random.default_rng(0), peak_e=5000), sensor(11, 10))
    assert found.lattice.arrangement == "hexagonal"
    assert found.lattice.pitch_px == pytest.approx(PITCH_PX, abs=0.01)
    assert found.lattice.rotation_rad == pytest.approx(rotation_rad, abs=5e-4)
    expected = centers_px(11, 10, rotation_rad)
    np.testing.assert_allclose(found.lattice.lenslet_centers_px(11, 10), expected, atol=0.1)
    assert found.illuminated.all()


@pytest.mark.parametrize(("x", "y"), [(-0.25, 0.5), (0.0, 0.5), (0.13, 0.47), (0.5, 0.0), (0.5, 0.5)])
def test_search_may_begin_between_lenslets(x: float, y: float) -> None:
    """The frame's middle, where it begins, lies there: (x, y) in pitches and rows from lenslet (5, 5)."""
    first = np.array([255.5 - x * PITCH_PX, 255.5 - y * PITCH_PX * np.sqrt(3) / 2])
    moved = first - centers_px(11, 10, 0)[5, 5]
    light = hexagons(np.ones((11, 10)), shape="pinhole", moved_px=(float(moved[0]), float(moved[1])))
    found = survey(photographed(light, np.random.default_rng(1), peak_e=1000), sensor(11, 10))
    np.testing.assert_allclose(found.lattice.lenslet_centers_px(11, 10), centers_px(11, 10, 0) + moved, atol=0.15)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.1, 0.45), (-0.2, -0.4), (0.3, 0.2)])
def test_phases_of_the_harmonics_are_the_offset_of_the_light(x: float, y: float) -> None:
    light = hexagons(np.ones((11, 10)), shape="pinhole")
    middle_px = centers_px(11, 10, 0)[5, 5]
    lattice = Lattice(
        center_x_px=middle_px[0] - x * PITCH_PX,
        center_y_px=middle_px[1] - y * PITCH_PX * np.sqrt(3) / 2,
        pitch_px=PITCH_PX,
        arrangement="hexagonal",
    )
    cells = cut(spline_coefficients(light.astype(np.float32)), lattice)
    near = np.abs(cells.index).max(axis=1) < 4
    inner = replace(cells, light=cells.light * near[:, None, None])
    found = inner.offset(np.angle(inner.harmonics().sum(axis=0)) / (2 * np.pi))
    np.testing.assert_allclose(found, [x, y * np.sqrt(3) / 2], atol=0.03)


def test_rotation_is_the_least_of_six() -> None:
    for rotation in (-14.9, 0, 30, 44.9):
        for turns in (-2, 1, 3):
            found = np.degrees(least_rotation_rad("hexagonal", np.radians(rotation + 60 * turns)))
            assert found == pytest.approx(rotation)


@pytest.mark.parametrize(("top", "left"), [(0, 0), (1, 0), (1, 2), (2, 1), (3, 3)])
def test_lit_block_is_found_from_even_and_from_odd_rows_on(top: int, left: int) -> None:
    """Blocks begin where light begins, whichever row that is; the row after the first lies to its right."""
    brightness = np.zeros((13, 13))
    row, column = np.indices(brightness.shape)
    start = left + (top % 2) * (row % 2 == 0)  # from an odd row on, even rows lie to the right
    brightness[(row >= top) & (row < top + 9) & (column >= start) & (column < start + 8)] = 1
    found = survey(hexagons(brightness), sensor(9, 8))
    assert found.illuminated.all()
    expected = centers_px(13, 13, 0)
    first = found.lattice.lenslet_centers_px(9, 8)[0, 0]
    np.testing.assert_allclose(first, expected[top, left], atol=0.1)


@pytest.mark.parametrize("moved_px", [-20.0, 0.0, 30.0])
def test_hexagonal_array_has_no_lenslets_in_the_corners(moved_px: float) -> None:
    """127 lenslets within six steps of the middle one, as commercial arrays have them, anywhere on the frame."""
    centers = centers_px(13, 14, 0) - centers_px(13, 14, 0)[6, 6]
    x, y = np.moveaxis(np.abs(centers) / PITCH_PX, -1, 0)
    lit = (y < 5.3) & (x + y / np.sqrt(3) < 6.1)
    assert lit.sum() == 127
    found = survey(hexagons(lit.astype(np.float64), shape="pinhole", moved_px=(moved_px, 0.0)), sensor(13, 13))
    assert found.illuminated.sum() == 127
    assert np.isnan(found.displacement_px[~found.illuminated]).all()
    own = found.lattice.lenslet_centers_px(13, 13)[found.illuminated]
    np.testing.assert_allclose(np.sort(own[:, 0]), np.sort(centers_px(13, 14, 0)[lit][:, 0]) + moved_px, atol=0.05)


def test_ring_is_centred_on_its_middle() -> None:
    light = hexagons(np.ones((11, 10)), shape="ring", half_width=0.36)
    found = survey(light, sensor(11, 10))
    np.testing.assert_allclose(found.lattice.lenslet_centers_px(11, 10), centers_px(11, 10, 0), atol=0.05)


def test_displaced_light_is_reported() -> None:
    beside = np.random.default_rng(2).normal(0, 0.4, (11, 10, 2))
    row, _ = np.indices((11, 10))
    regular = np.stack([np.where(row % 2, 0.25, -0.25), (row - 5) * (np.sqrt(3) / 2 - 1)], axis=-1) * PITCH_PX
    light = draw(
        FRAME,
        center_px=CENTER_PX,
        pitch_px=PITCH_PX,
        rotation_rad=0.0,
        brightness=np.ones((11, 10)),
        image_px=image_of("disc", PITCH_PX, 0.2, BLUR_PX),
        beside_px=regular + beside,
    )
    found = survey(light, sensor(11, 10))
    both = found.displacement_px + found.lattice.lenslet_centers_px(11, 10)
    np.testing.assert_allclose(both, centers_px(11, 10, 0) + beside, atol=0.08)


def test_square_lattice_is_refused_with_its_name() -> None:
    steps: list[str] = []
    with pytest.raises(ReconstructionError, match=r'a square one: set lattice\.arrangement = "square"'):
        survey(drawn(), sensor(15, 15), progress=lambda step, _: steps.append(step))
    assert steps[-1] == "fitting the lattice"  # and none of another pitch, which might seem to fit


def test_hexagonal_lattice_is_refused_by_a_square_sensor() -> None:
    with pytest.raises(ReconstructionError, match=r'a hexagonal one: set lattice\.arrangement = "hexagonal"'):
        survey(hexagons(np.ones((11, 10))), sensor_with(11, 10, 31.25))


def test_noise_is_no_hexagonal_lattice() -> None:
    with pytest.raises(ReconstructionError, match="was the light on"):
        survey(np.random.default_rng(3).normal(500, 8, FRAME), sensor(15, 13))


def test_lenslets_that_the_frame_does_not_show_are_absent() -> None:
    found = survey(hexagons(np.ones((11, 10))), sensor(20, 10))
    assert (found.illuminated.shape, found.illuminated.sum()) == ((20, 10), 110)
