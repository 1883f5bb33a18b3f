"""Positions of the camera image and its overlays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PyQt6.QtCore import QEvent, QPoint
from PyQt6.QtWidgets import QApplication
from support.gui_bench import FULL_SCALE, LATTICE, SENSOR, make_measurement
from support.window_tools import LENSLETS, MakeWindow, dim_frame, picture, views

from app.gui.widgets.camera_image import arrow_length_px
from reconstruction.displacement import LensletStatus
from reconstruction.geometry import Arrangement


def test_image_is_oriented_as_on_the_camera(make_window: MakeWindow) -> None:
    window = make_window()
    window.panels.camera.arrows_toggle.setChecked(False)
    pixels = dim_frame()
    pixels[:60, -40:] = 60000  # the upper right corner: row 0 is on top, column 0 on the left
    window.show_measurement(make_measurement(pixels, views()))
    graphics = window.panels.camera._graphics
    QApplication.processEvents()
    seen = picture(graphics).min(axis=2)
    row, column = np.nonzero(seen > 200)
    middle = graphics.rect().center()
    assert row.size > 400
    assert column.min() > middle.x() + 0.3 * graphics.width()
    assert row.max() < middle.y()
    width, height = np.ptp(column) + 1, np.ptp(row) + 1
    assert width / height == pytest.approx(40 / 60, rel=0.1)


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
def test_lost_lenslet_is_crossed_out_with_its_reason(make_window: MakeWindow, arrangement: Arrangement) -> None:
    window, lattice = make_window(), replace(LATTICE, arrangement=arrangement)
    outcome = np.zeros(LENSLETS, np.int8)
    outcome[1, 10] = LensletStatus.SATURATED
    panel = window.panels.camera
    panel.show_bench(replace(SENSOR, arrangement=arrangement), lattice, FULL_SCALE)
    window.show_measurement(make_measurement(dim_frame(), views(), outcome=outcome))
    QApplication.processEvents()
    seen = picture(panel._graphics).astype(int)
    row, column = np.nonzero((seen[..., 0] > 200) & (seen[..., 2] < 130))
    center = panel._view.mapSceneToView(QPoint(round(column.mean()), round(row.mean())).toPointF())
    expected = lattice.lenslet_centers_px(*LENSLETS)[1, 10]
    assert (center.x(), center.y()) == pytest.approx(tuple(expected), abs=2.0)
    panel._point_at(panel._view.mapViewToScene(center))
    assert "row 1, column 10: saturated" in panel.caption.text()
    panel._point_at(panel._view.mapViewToScene(center + QPoint(31, 0).toPointF()))
    assert panel.caption.text().endswith("lenslet row 1, column 11")


def test_colours_reach_from_the_black_to_the_white_level(make_window: MakeWindow) -> None:
    window = make_window()
    panel = window.panels.camera
    panel.show_bench(SENSOR, LATTICE, FULL_SCALE)
    panel.contrast.setCurrentText("Full range")
    pixels = dim_frame()
    pixels[0, :3] = 0, FULL_SCALE // 2, FULL_SCALE
    window.show_measurement(make_measurement(pixels, views()))
    for name, expected in (("grey", (0x000000, 0x7F7F7F, 0xFFFFFF)), ("inferno", (0x000003, 0xBB3754, 0xFCFEA4))):
        panel.colours.setChecked(name == "inferno")
        shown = panel._image.colours(pixels[0, :3]) & 0xFFFFFF
        for colour, other in zip(shown.tolist(), expected, strict=True):
            channels = [(colour >> shift & 0xFF) - (other >> shift & 0xFF) for shift in (0, 8, 16)]
            assert np.abs(channels).max() <= 3, (name, hex(colour))


def test_few_arrows_are_as_long_as_the_longest_needs() -> None:
    moved = np.full((*LENSLETS, 2), np.nan)  # lost
    assert np.isnan(arrow_length_px(moved))
    moved[4, 6], moved[2, 2] = (3.0, 4.0), (0.1, 0.0)
    assert arrow_length_px(moved) == pytest.approx(5.0)
    many = np.zeros((*LENSLETS, 2))
    many[..., 0] = 1.0
    many[0, 0, 0] = 50.0  # one of 117
    assert arrow_length_px(many) == pytest.approx(1.0)


def test_arrows_point_along_the_displacement(make_window: MakeWindow) -> None:
    window = make_window()
    panel = window.panels.camera
    panel.show_bench(SENSOR, LATTICE, FULL_SCALE)
    moved = np.full((*LENSLETS, 2), np.nan)
    outcome = np.full(LENSLETS, LensletStatus.DARK, np.int8)
    moved[4, 6], outcome[4, 6] = (1.2, 0.3), LensletStatus.CONVERGED
    window.show_measurement(make_measurement(dim_frame(), views(), outcome=outcome, displacement_px=moved))
    x, y = panel._arrows.ends.T
    magnification = float(panel.caption.text().rpartition(" ")[2])
    assert magnification == 20
    np.testing.assert_allclose([x[0], y[0]], [215.0, 150.5])  # the lattice's middle
    np.testing.assert_allclose([x[1] - x[0], y[1] - y[0]], [1.2 * magnification, 0.3 * magnification])


def test_pixel_is_named_only_under_the_pointer(make_window: MakeWindow) -> None:
    window = make_window()
    window.show_measurement(make_measurement(dim_frame(), views()))
    panel = window.panels.camera
    panel._point_at(panel._view.mapViewToScene(QPoint(7, 5).toPointF()))
    assert "x 7  y 5: 1000 counts" in panel.caption.text()
    QApplication.sendEvent(panel._graphics, QEvent(QEvent.Type.Leave))
    window.update_text()
    assert "counts" not in panel.caption.text()
