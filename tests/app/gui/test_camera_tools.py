"""Tools of the camera picture: the pupil, and rectangles around lenslets."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from PyQt6.QtCore import QPoint, QPointF, Qt
from PyQt6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from support.gui_bench import FULL_SCALE, LATTICE, SENSOR, FakeCamera, make_measurement
from support.window_tools import LENSLETS, MakeWindow, dim_frame, views, wait_for_wavefront

from app.gui.panels.camera import CameraPanel
from app.gui.shell.main_window import MainWindow


@pytest.fixture
def window(make_window: MakeWindow, qtbot: QtBot) -> MainWindow:
    window = make_window()
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    window.panels.camera.show_bench(SENSOR, LATTICE, FULL_SCALE)
    return window


def use_tool(panel: CameraPanel, name: str) -> None:
    panel.tool.setCurrentIndex(panel.tool.findData(name))


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


def test_drag_without_a_tool_moves_the_picture(window: MainWindow) -> None:
    panel = window.panels.camera
    window.show_measurement(make_measurement(dim_frame(), views()))
    panel._view.scaleBy((0.3, 0.3))
    before = panel._view.viewRect().center()
    drag(panel, (210, 150), (220, 150))
    assert panel._view.viewRect().center().x() == pytest.approx(before.x() - 10, abs=2)


def test_pupil_is_drawn_from_its_middle_to_its_edge(window: MainWindow) -> None:
    panel = window.panels.camera
    window.show_measurement(make_measurement(dim_frame(), views()))
    use_tool(panel, "pupil")
    drag(panel, (215, 150), (215 + 3 * LATTICE.pitch_px, 150))
    pupil = window.shown.pupil
    assert pupil is not None
    assert (pupil.center_x_m, pupil.center_y_m) == pytest.approx((0, 0), abs=0.1 * SENSOR.lenslet_pitch_m)
    assert pupil.radius_m == pytest.approx(3 * SENSOR.lenslet_pitch_m, rel=0.03)
    assert window.shown.wavefront is not None
    seen = np.isfinite(window.shown.wavefront.views)
    np.testing.assert_array_equal(seen, np.broadcast_to(pupil.contains(SENSOR.lenslet_centers_m), seen.shape))
    drag(panel, (2, 2), (20, 12))
    window.update_text()
    assert "No centre of a lenslet lies in the circle" in window.messages.log
    assert window.shown.pupil == pupil


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
    use_tool(panel, "exclude")
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
    use_tool(panel, "exclude")
    drag(panel, (140, 105), (290, 195))  # columns 4 ... 8, rows 3 ... 5
    qtbot.waitUntil(lambda: window.verdict.valid == "102 of 117")
    drag(panel, (140, 105), (230, 135))  # excluded already: as before
    qtbot.waitUntil(lambda: window.controller.is_settled)
    assert window._status is not None
    assert len(window._status.bench_in_force.registration.excluded) == 15
    use_tool(panel, "use again")
    drag(panel, (140, 105), (290, 195))
    qtbot.waitUntil(lambda: window.verdict.valid == "117 of 117")
    assert window._status.bench_in_force.registration.excluded == ()
    use_tool(panel, "exclude")
    drag(panel, (1, 1), (428, 298))  # all
    qtbot.waitUntil(lambda: window.controller.is_settled)
    window.messages.clear_notice()
    qtbot.waitUntil(lambda: "All lenslets are excluded by hand" in window.messages.text.text())
    assert "R: reference" not in window.messages.text.text()  # which would not help
    assert window._status.reference.validity == "good"
    use_tool(panel, "use again")
    drag(panel, (1, 1), (428, 298))
    qtbot.waitUntil(lambda: window.verdict.valid == "117 of 117")
