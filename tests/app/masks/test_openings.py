"""Narrowest openings and gaps of pictures, and the rectangles that their pixels make."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from app.masks.openings import narrowest_px, openings
from simulated_devices.settings import Source

Y, X = np.indices((120, 120)) - 59.5


def test_bars_are_measured_exactly() -> None:
    bars = np.zeros((60, 60), np.bool_)
    for left, right in ((3, 16), (23, 37), (46, 58)):
        bars[5:50, left:right] = True
    assert (narrowest_px(bars), narrowest_px(~bars, is_cut_off=True)) == (12, 7)
    assert (narrowest_px(bars.T), narrowest_px(~bars.T, is_cut_off=True)) == (12, 7)


@pytest.mark.parametrize("pixels", [1, 2, 3, 10])
def test_finest_detail_counts_beside_a_large_one(pixels: int) -> None:
    part = np.zeros((60, 60), np.bool_)
    part[5:45, 5:45] = True
    part[50 : 50 + pixels, 10:55] = True
    assert narrowest_px(part) == pixels
    part[:] = False
    part[5:45, 5:45] = True
    part[20 : 20 + pixels, 10 : 10 + pixels] = False
    assert narrowest_px(~part, is_cut_off=True) == pixels


@pytest.mark.parametrize(("length", "narrowest"), [(5, 12), (2, 40)])
def test_arm_counts_from_a_quarter_of_its_width_in_length(length: int, narrowest: int) -> None:
    part = np.zeros((60, 60), np.bool_)
    part[5:45, 5:45] = True
    part[45 : 45 + length, 20:32] = True
    assert narrowest_px(part) == narrowest


@pytest.mark.parametrize("diameter", [8, 20, 50, 100])
def test_disc_is_not_taken_for_its_caps(diameter: int) -> None:
    found = narrowest_px(np.hypot(X, Y) < diameter / 2)
    assert found is not None
    assert 0.6 * diameter < found <= diameter


@pytest.mark.parametrize("width", [4, 10, 16])
@pytest.mark.parametrize("angle", [0.2, 0.5, np.pi / 4, 1.2])
def test_slanting_line_is_never_taken_for_wider(width: int, angle: float) -> None:
    line = np.abs(X * np.sin(angle) - Y * np.cos(angle)) < width / 2
    found = narrowest_px(line | (np.hypot(X, Y) > 40))
    assert found is not None
    assert 0.6 * width < found <= width


@pytest.mark.parametrize("part", [np.ones((1, 1), np.bool_), np.ones((7, 9), np.bool_), np.hypot(X, Y) < 40])
def test_one_opening_has_no_gap(part: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> None:
    assert narrowest_px(~part, is_cut_off=True) is None


@given(arrays(np.bool_, st.tuples(st.integers(1, 9), st.integers(1, 9))).filter(lambda picture: bool(picture.any())))
def test_rectangles_cover_every_open_pixel_once(picture: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> None:
    path = Path("picture.npy")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("app.masks.openings.read_grey_image", lambda _: picture.astype(np.float64))
        patch.setattr(Path, "exists", lambda _: True)
        patch.setattr("app.masks.openings.check_readable", lambda _: None)
        mask = openings(str(path), Source(), 1e-3)
    pixel_m, count = 1e-3 / max(picture.shape), np.zeros(picture.shape, int)
    middle = np.array(picture.shape)[::-1] / 2
    for corners_m in mask.polygons_m:
        (left, top), (right, bottom) = (corners_m[[0, 2]] / pixel_m + middle).round().astype(int)
        count[top:bottom, left:right] += 1
    assert np.array_equal(count, picture)
    assert mask.area_m2 == pytest.approx(picture.sum() * pixel_m**2)
    quarters = (picture[:-1, :-1], picture[:-1, 1:], picture[1:, :-1], picture[1:, 1:])
    touching = sum(a == d != b == c for a, b, c, d in zip(*(each.ravel() for each in quarters), strict=True))
    assert mask.touching == touching


def test_enlarged_picture_is_the_same_mask(tmp_path: Path) -> None:
    picture = np.array([[1, 0, 1], [1, 1, 0]], np.uint8)
    cv2.imwrite(str(tmp_path / "small.png"), picture)
    cv2.imwrite(str(tmp_path / "large.png"), np.kron(picture, np.full((60, 60), 255, np.uint8)))
    small, large = (openings(str(tmp_path / f"{name}.png"), Source(), 1e-3) for name in ("small", "large"))
    facts, of_large = ((each.width_m, each.gap_m, each.touching, len(each.polygons_m)) for each in (small, large))
    assert facts == of_large


def test_area_of_many_polygons_is_theirs(tmp_path: Path) -> None:
    np.save(tmp_path / "chequer.npy", np.indices((200, 200)).sum(axis=0) % 2)
    drawn = openings(str(tmp_path / "chequer.npy"), Source(), 1e-3)
    assert len(drawn.polygons_m) == 20_000
    assert drawn.area_m2 == pytest.approx(0.5e-6)
    assert drawn.reach_m == pytest.approx(1e-3 / math.sqrt(2))
