"""Tools of the camera picture: line, area, and rectangles around lenslets; closed forms and NumPy say what is right."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import replace

import numpy as np
import pytest
from PyQt6.QtCore import QPoint, QPointF, Qt
from PyQt6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from support.gui_bench import FIELD, FULL_SCALE, LATTICE, SENSOR, FakeCamera, make_measurement
from support.window_tools import LENSLETS, MakeWindow, count_pixels, dim_frame, press, views, wait_for_wavefront

from app.gui.panels.camera import CameraPanel
from app.gui.shell.main_window import MainWindow
from app.results.frame_statistics import AreaStatistics, area_statistics, lengths_of, profile


@pytest.fixture
def window(make_window: MakeWindow, qtbot: QtBot) -> MainWindow:
    window = make_window()
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    window.panels.camera.show_bench(SENSOR, LATTICE, FULL_SCALE)
    window.panels.camera.measuring.show_bench(SENSOR, FIELD)
    return window


def drag(panel: CameraPanel, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Drag with the left button from one camera pixel to another."""
    QApplication.processEvents()
    viewport, button = panel._graphics.viewport(), Qt.MouseButton.LeftButton
    first, last = (panel._graphics.mapFromScene(panel._view.mapViewToScene(QPointF(*one))) for one in (start, end))
    QtBot.mousePress(viewport, button, pos=first)  # type: ignore[no-untyped-call] # pytest-qt declares no types
    for step in range(1, 6):
        at = QPoint(*(round(a + (b - a) * step / 5) for a, b in ((first.x(), last.x()), (first.y(), last.y()))))
        QtBot.mouseMove(viewport, at)  # type: ignore[no-untyped-call] # again
        time.sleep(0.015)  # pyqtgraph skips moves that come faster
        QApplication.processEvents()
    QtBot.mouseRelease(viewport, button, pos=last)  # type: ignore[no-untyped-call] # again
    QApplication.processEvents()


def test_profile_of_a_plane_is_a_straight_line() -> None:
    y, x = np.meshgrid(np.arange(40), np.arange(60), indexing="ij")
    along_px, counts = profile((100 + 3 * x + 5 * y).astype(np.uint16), (10.25, 4.5), (40.25, 44.5))
    assert along_px[-1] == pytest.approx(50)  # a triangle of 30, 40, 50
    assert np.diff(along_px).max() < 1 + 1e-9
    inside = along_px <= 50 * (39 - 4.5) / 40
    expected = 100 + 3 * (10.25 + 0.6 * along_px) + 5 * (4.5 + 0.8 * along_px)
    np.testing.assert_allclose(counts[inside], expected[inside])
    assert np.isnan(counts[~inside]).all()


def test_pixels_within_a_rectangle_are_those_whose_centres_are() -> None:
    pixels = np.arange(20, dtype=np.uint16).reshape(4, 5)
    inside = [1, 2, 3, 6, 7, 8]
    found = area_statistics(pixels, (0.6, 3.0), (-7.0, 1.4), clip_level=7)
    assert found == AreaStatistics(2, 3, 4.5, statistics.pstdev(inside), 1, 8, clipped=2)
    for x_px, y_px in (((0.2, 0.8), (0, 3)), ((-9, -2), (0, 3)), ((5, 9), (0, 3))):
        assert area_statistics(pixels, x_px, y_px) is None


def test_length_on_the_camera_is_an_angle_and_a_length_of_the_source() -> None:
    sensor = replace(SENSOR, pixel_pitch_m=16e-6, lenslet_focal_length_m=0.04)
    assert lengths_of(50.0, sensor, FIELD) == pytest.approx((0.8e-3, 0.02, 0.02 * FIELD.collimator_focal_length_m))


def test_line_shows_length_and_profile_of_each_frame(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.camera
    window.show_measurement(make_measurement(dim_frame(), views()))
    press(qtbot, window, Qt.Key.Key_M)
    assert panel.tool.currentData() == "line"
    QApplication.processEvents()
    before = panel._view.viewRect()
    drag(panel, (100, 80), (300, 230))
    assert panel._view.viewRect() == before  # not moved
    start, end = (panel.measuring.line.mapToParent(point) for point in panel.measuring.line.listPoints())
    assert (start.x(), start.y(), end.x(), end.y()) == pytest.approx((100, 80, 300, 230), abs=1.5)
    panel.measuring.place("line", QPointF(100, 80), QPointF(300, 230))  # 200, 150, 250 px
    um = 250 * SENSOR.pixel_pitch_m * 1e6
    mrad = um / SENSOR.lenslet_focal_length_m / 1e3
    assert panel.measuring.reading.text() == (
        f"250.0 px = {um:.0f} \N{MICRO SIGN}m on the sensor; within a subimage {mrad:.1f} mrad,"
        f" {mrad * FIELD.collimator_focal_length_m:.1f} mm of the source"
    )
    y, x = np.meshgrid(np.arange(300), np.arange(430), indexing="ij")
    window.show_measurement(make_measurement((10 * x + 20 * y).astype(np.uint16), views()))
    count_pixels(qtbot, window)
    along_px, counts = panel.measuring.curve.getData()
    np.testing.assert_allclose(counts, 10 * (100 + 0.8 * along_px) + 20 * (80 + 0.6 * along_px))
    assert panel.measuring.plot.isVisible()
    press(qtbot, window, Qt.Key.Key_Escape)
    assert panel.tool.currentData() == "inspect"
    assert not panel.measuring.isVisible()
    assert not panel.measuring.line.isVisible()


def test_area_counts_its_pixels(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.camera
    pixels = dim_frame()
    pixels[100:130, 200:240] = np.random.default_rng(3).integers(900, 1100, (30, 40))
    pixels[100, 200:205] = FULL_SCALE
    qtbot.keyClick(window, Qt.Key.Key_M, Qt.KeyboardModifier.ShiftModifier)  # type: ignore[no-untyped-call] # pytest-qt declares no types
    window.show_measurement(make_measurement(pixels, views()))
    count_pixels(qtbot, window)
    drag(panel, (240, 130), (199, 99))  # from the lower right corner
    assert panel.measuring.area.isVisible()
    assert not panel.measuring.plot.isVisible()
    panel.measuring.place("area", QPointF(239.4, 129.4), QPointF(199.6, 99.6))
    inside = pixels[100:130, 200:240]
    wide, high = (f"{number * SENSOR.pixel_pitch_m * 1e6:.1f}" for number in (40, 30))
    expected = (
        f"40 x 30 px = {wide} x {high} \N{MICRO SIGN}m: mean {inside.mean():.1f}, \N{GREEK SMALL LETTER SIGMA}"
        f" {inside.std():.0f}, {inside.min()} ... 65535 counts, 5 saturated"
    )
    qtbot.waitUntil(lambda: panel.measuring.reading.text() == expected)
    panel.measuring.place("area", QPointF(-30, -30), QPointF(-10, -10))
    qtbot.waitUntil(lambda: panel.measuring.reading.text() == "no pixel lies in the area")


def test_line_ends_beside_the_picture(window: MainWindow, qtbot: QtBot) -> None:
    measuring = window.panels.camera.measuring
    window.show_measurement(make_measurement(dim_frame(), views()))
    window.panels.camera.use_tool("line")
    measuring.place("line", QPointF(-1e9, -1e9), QPointF(1e9, 1e9))
    count_pixels(qtbot, window)
    along_px, _ = measuring.curve.getData()
    assert along_px[-1] == pytest.approx(3 * math.hypot(430, 300))
    measuring.place("area", QPointF(-1e9, -1e9), QPointF(1e9, 1e9))
    qtbot.waitUntil(lambda: measuring.reading.text().startswith("430 x 300 px"))


def test_drag_without_a_tool_moves_the_picture(window: MainWindow) -> None:
    panel = window.panels.camera
    window.show_measurement(make_measurement(dim_frame(), views()))
    panel._view.scaleBy((0.3, 0.3))
    before = panel._view.viewRect().center()
    drag(panel, (210, 150), (220, 150))
    assert panel._view.viewRect().center().x() == pytest.approx(before.x() - 10, abs=2)
    assert not panel.measuring.isVisible()


def test_frame_stays_in_sight(window: MainWindow) -> None:
    panel = window.panels.camera
    window.show_measurement(make_measurement(dim_frame(), views()))
    panel._view.scaleBy((0.3, 0.3))
    for far_px, corner in ((1000, (429.5, 299.5)), (-1000, (-0.5, -0.5))):
        panel._view.translateBy(x=far_px, y=far_px)
        middle = panel._view.viewRect().center()
        assert (middle.x(), middle.y()) == pytest.approx(corner)


@pytest.mark.parametrize("angle_rad", [0.0, 0.1])
def test_lenslets_are_those_whose_centres_lie_in_the_rectangle(window: MainWindow, angle_rad: float) -> None:
    panel = window.panels.camera
    lattice = replace(LATTICE, rotation_rad=angle_rad)
    panel.show_bench(SENSOR, lattice, FULL_SCALE)
    window.show_measurement(make_measurement(dim_frame(), views()))
    asked: list[tuple[list[tuple[int, int]], bool | None]] = []
    panel.shown.exclusion_requested.disconnect()
    panel.shown.exclusion_requested.connect(lambda *which: asked.append(which))
    panel.use_tool("exclude")
    drag(panel, (260, 190), (160, 110))
    turn = np.exp(1j * angle_rad)
    places = {at: complex(215, 150.5) + 31.25 * turn * complex(at[1] - 6, at[0] - 4) for at in np.ndindex(LENSLETS)}
    expected = [at for at, z in places.items() if 160 <= z.real <= 260 and 110 <= z.imag <= 190]
    assert asked == [(expected, True)]
    assert len(expected) > 5
    drag(panel, (2, 2), (24, 12))
    window.update_text()
    assert window.messages.text.text() == "No centre of a lenslet lies in the rectangle"
    assert len(asked) == 1


@pytest.mark.slow
@pytest.mark.long
def test_mask_drawn_by_hand_and_undone(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    wait_for_wavefront(qtbot, window)
    panel = window.panels.camera
    panel.reset_zoom()
    panel.use_tool("exclude")
    drag(panel, (140, 105), (290, 195))  # columns 4 ... 8, rows 3 ... 5
    qtbot.waitUntil(lambda: window.verdict.valid == "102 of 117")
    drag(panel, (140, 105), (230, 135))  # excluded already: as before
    qtbot.waitUntil(lambda: window.controller.is_settled)
    assert window._status is not None
    assert len(window._status.bench_in_force.registration.excluded) == 15
    panel.use_tool("use again")
    drag(panel, (140, 105), (290, 195))
    qtbot.waitUntil(lambda: window.verdict.valid == "117 of 117")
    assert window._status.bench_in_force.registration.excluded == ()
    panel.use_tool("exclude")
    drag(panel, (1, 1), (428, 298))  # all
    qtbot.waitUntil(lambda: window.controller.is_settled)
    window.messages.clear_notice()
    qtbot.waitUntil(lambda: "All lenslets are excluded by hand" in window.messages.text.text())
    assert "R: reference" not in window.messages.text.text()  # which would not help
    assert window._status.reference.validity == "good"
    panel.use_tool("use again")
    drag(panel, (1, 1), (428, 298))
    qtbot.waitUntil(lambda: window.verdict.valid == "117 of 117")
