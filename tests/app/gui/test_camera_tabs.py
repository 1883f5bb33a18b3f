"""Clipped pixels, histogram, and the lenslet inspector."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PyQt6.QtCore import QPoint, QPointF, Qt
from PyQt6.QtGui import QAction, QContextMenuEvent
from PyQt6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot
from support.gaussian_lenslets import inspected
from support.gui_bench import BENCH, FULL_SCALE, LATTICE, SENSOR, FakeCamera, make_measurement
from support.patience import HANG_S
from support.wavefronts import bowl
from support.window_tools import LENSLETS, MakeWindow, count_pixels, dim_frame, picture, views

from app.gui.panels.camera import CameraPanel
from app.gui.shell.main_window import MainWindow
from app.measurement.measurement import Measurement
from app.results.view_maps import LensletInspection, inspect_lenslet
from reconstruction.displacement import LensletStatus


@pytest.fixture
def window(make_window: MakeWindow) -> MainWindow:
    made = make_window()
    made.panels.camera.show_bench(SENSOR, LATTICE, FULL_SCALE)
    made.panels.camera.arrows_toggle.setChecked(False)
    made.shown.reconstruction = BENCH.reconstruction
    return made


def click_lenslet(panel: CameraPanel, row: int, column: int) -> None:
    QApplication.processEvents()
    x, y = LATTICE.lenslet_centers_px(*LENSLETS)[row, column]
    at = panel._graphics.mapFromScene(panel._view.mapViewToScene(QPointF(x, y)))
    viewport = panel._graphics.viewport()
    QtBot.mouseClick(viewport, Qt.MouseButton.LeftButton, pos=QPoint(at.x(), at.y()))  # type: ignore[no-untyped-call] # pytest-qt declares no types


def show_pixels(qtbot: QtBot, window: MainWindow, pixels: NDArray[np.uint16]) -> None:
    """Show a frame twice: a full well below full scale is found in the first one."""
    for _ in range(2):
        window.show_measurement(make_measurement(pixels, views()))
        count_pixels(qtbot, window)
    QApplication.processEvents()


def redness(window: MainWindow) -> int:
    seen = picture(window.panels.camera._graphics).astype(int)
    return int(np.count_nonzero((seen[..., 0] > 200) & (seen[..., 1] < 130)))


@pytest.mark.parametrize(
    ("level", "text", "is_red"),
    [
        (60000, "Peak 92 % of full scale", False),
        (63000, "Peak 96 % of full scale: nearly saturated, shorten the exposure", False),
        (65535, "Peak 100 % of full scale, 0.9 % of the pixels clipped", True),
    ],
)
def test_clipped_pixels_are_red_and_nearly_clipped_ones_warned_of(
    window: MainWindow, qtbot: QtBot, level: int, text: str, is_red: bool
) -> None:
    pixels = dim_frame()
    pixels[100:130, 50:90] = level if is_red else np.linspace(0.9 * level, level, 40)
    show_pixels(qtbot, window, pixels)
    assert text in window.panels.camera.caption.text()
    assert (redness(window) > 300) is is_red
    show_pixels(qtbot, window, dim_frame())
    assert "saturated" not in window.panels.camera.caption.text()
    assert redness(window) == 0


def test_full_well_below_full_scale_is_red(window: MainWindow, qtbot: QtBot) -> None:
    pixels = dim_frame()
    pixels[100:130, 50:90] = np.random.default_rng(2).integers(63990, 64000, (30, 40), np.uint16)
    show_pixels(qtbot, window, pixels)
    assert "Peak 98 % of full scale, 0.9 % of the pixels clipped" in window.panels.camera.caption.text()
    assert redness(window) > 300


def test_histogram_follows_the_frame_while_it_is_shown(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.histogram
    pixels = np.random.default_rng(1).integers(0, 60000, (300, 430), np.uint16)
    window.show_measurement(make_measurement(pixels, views()))
    count_pixels(qtbot, window)
    assert panel.curve.getData()[1].size == 1  # hidden: nothing is drawn
    panel.front_requested.emit()
    QApplication.processEvents()
    window.update_text()
    level, logarithm = panel.curve.getData()
    expected, _ = np.histogram(pixels, level)
    np.testing.assert_allclose(10**logarithm, np.maximum(expected, 0.8))
    assert [line.value() for line in panel._lines] == [pytest.approx(0.95 * FULL_SCALE), FULL_SCALE]
    assert panel.plot.title.text() == f"Histogram: peak {pixels.max()} of 65535 counts"


def shown(measurement: Measurement) -> Measurement:
    """With a wavefront whose isoplanatism can be computed."""
    return replace(measurement, wavefront=bowl())


def test_click_on_a_lenslet_opens_its_inspector(
    window: MainWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel, go_on = window.panels.lenslet, threading.Event()

    def inspect_later(*arguments: Any) -> LensletInspection | None:
        assert go_on.wait(HANG_S)
        return inspect_lenslet(*arguments)

    monkeypatch.setattr("app.gui.panels.lenslet.inspect_lenslet", inspect_later)
    window.show_measurement(shown(inspected()))
    assert panel.request() is None
    click_lenslet(window.panels.camera, 4, 7)
    qtbot.waitUntil(panel.isVisible)
    assert not window.panels.quality.isVisible()
    assert panel.numbers.text() == "Computing\N{HORIZONTAL ELLIPSIS}"
    go_on.set()
    qtbot.waitUntil(lambda: bool(panel.quality.text()))
    assert panel.name.text() == "Lenslet row 4, column 7: converged"
    assert panel.numbers.text().startswith(
        "Displacement x +1.300 \N{PLUS-MINUS SIGN} 0.020, y \N{MINUS SIGN}0.800 \N{PLUS-MINUS SIGN} 0.030 px"
    )
    maps = {name: tile.maps for name, tile in panel.tiles.items()}
    for name in ("Reference", "Frame", "Warped back", "Residual"):
        assert maps[name] is not None, name
    reference, back = maps["Reference"], maps["Warped back"]
    assert reference is not None
    assert back is not None
    middle = reference.values.shape[2] // 2
    assert back.values[0, 0, middle, middle] == pytest.approx(reference.values[0, 0, middle, middle], rel=0.01)
    outline = window.panels.camera._inspected_box.ends.T
    centre = LATTICE.lenslet_centers_px(*LENSLETS)[4, 7]
    np.testing.assert_allclose([outline[0].mean(), outline[1].mean()], centre)


def test_lost_lenslet_is_inspected_with_its_reason(window: MainWindow, qtbot: QtBot) -> None:
    measurement = inspected()
    assert measurement.registered is not None
    outcome = measurement.registered.outcome.copy()
    outcome[2, 3] = LensletStatus.LEFT_CELL
    window.show_measurement(shown(replace(measurement, registered=replace(measurement.registered, outcome=outcome))))
    click_lenslet(window.panels.camera, 2, 3)
    panel = window.panels.lenslet
    qtbot.waitUntil(lambda: panel.tiles["Frame"].maps is not None)
    assert panel.name.text() == "Lenslet row 2, column 3: lost, left its cell"
    assert panel.tiles["Residual"].maps is None


def test_lenslet_without_reference_is_explained(window: MainWindow, qtbot: QtBot) -> None:
    window.show_measurement(shown(make_measurement(dim_frame(), views())))
    click_lenslet(window.panels.camera, 2, 3)
    panel = window.panels.lenslet
    qtbot.waitUntil(lambda: panel.numbers.text().startswith("nothing to inspect"))
    click_lenslet(window.panels.camera, 4, 4)
    qtbot.waitUntil(lambda: panel.name.text() == "Lenslet row 4, column 4")


def menu_at(widget: QWidget, at: QPoint) -> dict[str, QAction]:
    """Open the menu of a panel by a right click, and return its entries."""
    QApplication.sendEvent(widget, QContextMenuEvent(QContextMenuEvent.Reason.Mouse, at, widget.mapToGlobal(at)))
    menu = QApplication.activePopupWidget()
    assert menu is not None
    entries = {action.text(): action for action in menu.actions()}
    menu.close()
    return entries


def test_right_click_opens_the_menu_of_the_panel_which_copies(window: MainWindow) -> None:
    window.show_measurement(make_measurement(dim_frame(), views(3)))
    QApplication.processEvents()
    grid, clipboard = window.panels.wavefronts.grid, QApplication.clipboard()
    assert clipboard is not None
    entries = menu_at(grid, grid.places.tile(1, 2).center())
    entries["Copy the numbers"].trigger()
    lines = [line.split("\t") for line in clipboard.text().splitlines()]
    assert lines[0][:5] == ["view row", "view column", "row", "column", "value (rad)"]
    np.testing.assert_allclose([float(line[4]) for line in lines[1:]], views(3).ravel(), rtol=1e-6)
    entries["Copy the picture"].trigger()
    assert clipboard.pixmap().size() == window.panels.wavefronts.grab().size()
    camera = window.panels.camera._graphics.viewport()
    assert camera is not None
    menu_at(camera, camera.rect().center())["Copy the numbers"].trigger()
    heads, *rows = clipboard.text().splitlines()
    assert heads.split("\t") == ["row", "column", "x (px)", "y (px)"]
    assert len(rows) == np.prod(LENSLETS)
    plot = window.panels.quality.mtf
    plot._curves[0].setData([0.0, 1.0], [1.0, 0.5])
    menu_at(plot, QPoint(5, 5))["Copy the numbers"].trigger()
    assert "cycles per mrad\tMTF\n0\t1\n1\t0.5" in clipboard.text()


@pytest.mark.slow
@pytest.mark.long
def test_lenslet_is_excluded_by_hand_and_used_again(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    camera, lenslet = window.panels.camera, window.panels.lenslet
    camera._view.setRange(camera._image.boundingRect())
    x, y = LATTICE.lenslet_centers_px(*LENSLETS)[3, 5]
    at = camera._view.mapViewToScene(QPointF(x, y))
    camera._graphics.scene().sigMouseMoved.emit(at)  # as the pointer does on its way
    entries = menu_at(camera._graphics, camera._graphics.mapFromScene(at))
    entries["Exclude lenslet row 3, column 5, or use it again"].trigger()
    qtbot.waitUntil(lambda: window.verdict.valid == "116 of 117")  # the wavefront goes on
    assert window._status is not None
    assert window._status.bench_in_force.registration.excluded == ((3, 5),)  # saved and recorded with the bench
    assert "1 lost: excluded by hand" in window.verdict.toolTip()
    window.panels.lenslet.inspect(3, 5)
    qtbot.waitUntil(lambda: lenslet.exclude.text() == "Use again")
    assert lenslet.name.text() == "Lenslet row 3, column 5: lost, excluded by hand"
    lenslet.exclude.click()
    qtbot.waitUntil(lambda: window.verdict.valid == "117 of 117")
    qtbot.waitUntil(lambda: lenslet.exclude.text() == "Exclude")
