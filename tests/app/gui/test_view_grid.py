"""Grid of views: positions, colours and numbers."""

from __future__ import annotations

import numpy as np
import pytest
from PyQt6.QtCore import QPoint
from pytestqt.qtbot import QtBot
from support.gui_bench import make_measurement
from support.window_tools import LENSLETS, MakeWindow, dim_frame, part, picture

from app.gui.widgets.presentation import MAGNIFICATIONS, NOTHING, RANGES, AdaptiveScale, diverging, with_error
from app.gui.widgets.view_grid import Maps, ViewGrid
from reconstruction.arrays import Floats


def show(grid: ViewGrid, phase: Floats, limit_rad: float) -> None:
    grid.show_maps(Maps(phase, diverging(limit_rad, "rad"), lambda row, column, value: f"{row} {column} {value}"))


def test_views_lie_as_in_the_field_and_lenslets_as_in_the_pupil(make_window: MakeWindow) -> None:
    window = make_window()
    shown = np.zeros((3, 3, *LENSLETS))
    shown[0, 2, 1, 10] = 5.0  # the view on top at the right; in it a lenslet in the second row, near the right edge
    window.show_measurement(make_measurement(dim_frame(), shown))
    grid = window.panels.wavefronts.grid
    show(grid, shown, 5.0)
    seen = picture(grid).astype(int)
    tiles = grid.places.tile(0, 0).united(grid.places.tile(2, 2))
    red = (seen[..., 0] - seen[..., 2] > 120)[:, : tiles.right() + 1]
    row, column = np.nonzero(red)
    assert row.size > 20
    x = (column.mean() + 0.5 - tiles.left()) / tiles.width()
    y = (row.mean() + 0.5 - tiles.top()) / tiles.height()
    assert x == pytest.approx(2 / 3 + 10.5 / 13 / 3, abs=0.03)
    assert y == pytest.approx(1.5 / 9 / 3, abs=0.03)


def test_stale_map_is_grey_and_keeps_its_sign(make_window: MakeWindow) -> None:
    grid = make_window().panels.wavefronts.grid
    shown = np.zeros((3, 3, *LENSLETS))
    shown[1, 0], shown[1, 2] = -2, 2
    show(grid, shown, 2.0)
    grid.show_stale(is_stale=True)
    seen = picture(grid).astype(int)
    tiles = [part(seen, grid.places.tile(1, column).adjusted(2, 2, -2, -2)) for column in range(3)]
    assert max(np.ptp(tile, axis=-1).max() for tile in tiles) < 10
    left, middle, right = (tile.mean() for tile in tiles)
    assert left + 30 < middle < right - 30
    assert grid.maps is not None
    bar = part(seen, grid._bar(grid.maps)).mean(axis=(1, 2))
    assert [bar[-2], bar[1]] == pytest.approx([left, right], abs=3)  # the colours of the maps
    grid.show_stale(is_stale=False)
    assert np.ptp(part(picture(grid).astype(int), grid.places.tile(1, 2)).mean(axis=(0, 1))) > 100


def test_positive_is_red_and_negative_is_blue(make_window: MakeWindow) -> None:
    window = make_window()
    shown = np.zeros((3, 3, *LENSLETS))
    shown[1, 0], shown[1, 2] = -2, 2
    grid = window.panels.wavefronts.grid
    show(grid, shown, 2.0)
    seen = picture(grid).astype(int)
    left, middle, right = (part(seen, grid.places.tile(1, column)).mean(axis=(0, 1)) for column in range(3))
    assert left[2] > left[0] + 100
    assert right[0] > right[2] + 100
    assert abs(middle[0] - middle[2]) < 20


def test_lost_lenslet_is_hatched_not_zero(make_window: MakeWindow) -> None:
    window = make_window()
    shown = np.zeros((3, 3, *LENSLETS))
    shown[1, 1, 2, 3] = np.nan
    window.show_measurement(make_measurement(dim_frame(), shown))
    grid = window.panels.wavefronts.grid
    tile = part(picture(grid).astype(int), grid.places.tile(1, 1))
    step_y, step_x = tile.shape[0] / LENSLETS[0], tile.shape[1] / LENSLETS[1]
    lost = tile[int(2.25 * step_y) : int(2.75 * step_y), int(3.25 * step_x) : int(3.75 * step_x)]
    zero = tile[int(5.25 * step_y) : int(5.75 * step_y), int(3.25 * step_x) : int(3.75 * step_x)]
    assert zero.min() > 200  # the middle of the colours is nearly white
    assert lost.max() < 150
    assert "lost" in grid._value_at(grid.places.tile(1, 1).topLeft() + QPoint(int(3.5 * step_x), int(2.5 * step_y)))


def test_captions_ignore_lenslets_without_value(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    shown = np.tile(np.where(np.arange(LENSLETS[1]) % 2, 1.0, -1.0)[1:], (3, 3, LENSLETS[0], 1))
    shown = np.concatenate([np.full((*shown.shape[:3], 1), np.nan), shown], axis=3)  # lost in every view
    shown[0, 0] = np.nan  # a view outside the field
    window.show_measurement(make_measurement(dim_frame(), shown))
    qtbot.waitUntil(lambda: bool(window.panels.wavefronts.grid.captions))
    captions = window.panels.wavefronts.grid.captions
    assert captions[0, 0][0][0] == "RMS \N{EN DASH} rad, PV \N{EN DASH}"
    assert {captions[at][0][0] for at in captions if at != (0, 0)} == {"RMS 1.00 rad, PV 2.00"}
    assert window.panels.wavefronts._summary.text() == "Mean RMS 1.00 rad"
    picture(window.panels.wavefronts.grid)


def test_scale_rises_at_once_and_falls_only_when_clearly_too_large() -> None:
    scale = AdaptiveScale(MAGNIFICATIONS)
    assert [scale.follow(needed) for needed in (1.7, 2.1, 1.9, 1.7, 1.5, np.nan, 0.0)] == [2, 5, 5, 5, 2, 2, 2]
    assert AdaptiveScale(RANGES).follow(11) == 15


def test_largest_number_stands_at_the_top_of_the_colour_bar(
    make_window: MakeWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = make_window().panels.wavefronts.grid
    monkeypatch.setattr(grid, "_ticks", lambda *_: ((0.0, ""), (1.0, "8888")))
    show(grid, np.zeros((3, 3, *LENSLETS)), 2.0)
    assert grid.maps is not None
    bar = grid._bar(grid.maps)
    numbers = bar.adjusted(bar.width() + 6, 0, 30, 0)
    ink = np.abs(np.diff(part(picture(grid).astype(int), numbers).sum(axis=2), axis=1)).sum(axis=1)
    assert ink[: ink.size // 3].sum() > 100 + 2 * ink[ink.size // 3 :].sum()


@pytest.mark.parametrize(("height", "has_captions"), [(400, True), (230, True), (120, False)])
def test_captions_give_way_to_small_views(qtbot: QtBot, height: int, has_captions: bool) -> None:
    grid = ViewGrid((10, 10))
    qtbot.addWidget(grid)
    grid.resize(420, height)
    show(grid, np.zeros((3, 3, 15, 15)), 1.0)
    assert grid.places.has_captions == has_captions


@pytest.mark.parametrize(
    ("value", "sigma", "texts"),
    [
        (-1.0312, 0.0213, ("-1.031", "0.021")),
        (1.3, 0.00996, ("+1.300", "0.010")),
        (123.4, 5.21, ("+123.4", "5.2")),
        (0.5, 0.0, ("+0.500", "0")),
        (np.nan, 1.0, ("", "1.0")),
    ],
)
def test_value_and_error_end_at_the_same_decimal(value: float, sigma: float, texts: tuple[str, str]) -> None:
    found = with_error(value, sigma)
    assert found == (texts[0].replace("-", "\N{MINUS SIGN}") or NOTHING, texts[1])
