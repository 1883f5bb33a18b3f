"""The display menu, and the enlarged view."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PyQt6.QtCore import QPoint, Qt
from PyQt6.QtGui import QAction
from PyQt6.QtTest import QTest
from PyQt6.QtWidgets import QApplication, QFileDialog, QMenu
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, LATTICE, SENSOR, make_measurement
from support.patience import HANG_S
from support.wavefronts import bowl, modal
from support.window_tools import LENSLETS, MakeWindow, click, dim_frame, part, picture, press, views

from app.gui.panels.wavefronts import WavefrontPanel
from app.gui.shell.main_window import MainWindow
from app.gui.widgets.enlarged_view import EnlargedView
from app.gui.widgets.presentation import number, signed
from app.results.dataset import result_dataset
from app.results.result_file import write_results
from app.results.shown_wavefront import StoredWavefront
from app.results.view_maps import Quantity
from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.pupil import Pupil
from reconstruction.wavefront import Wavefront


@pytest.fixture
def window(make_window: MakeWindow, qtbot: QtBot) -> MainWindow:
    made = make_window()
    made.shown.reconstruction = BENCH.reconstruction
    made.panels.wavefronts.show_wavefront(bowl(3000.0))
    qtbot.waitUntil(lambda: bool(made.panels.wavefronts.grid.captions))
    return made


def shown(window: MainWindow) -> Floats:
    maps = window.panels.wavefronts.grid.maps
    assert maps is not None
    return maps.values


def choose(qtbot: QtBot, menu: QMenu | None, *texts: str) -> None:
    """Open a menu and choose entries with the keyboard, one inside the other."""
    assert menu is not None
    menu.popup(QPoint(0, 0))
    action = next(action for action in menu.actions() if action.text() == texts[0])
    if len(texts) > 1:
        choose(qtbot, action.menu(), *texts[1:])
    else:
        menu.setActiveAction(action)
        press(qtbot, menu, Qt.Key.Key_Return)
    menu.close()


def test_menu_changes_what_is_shown(window: MainWindow, qtbot: QtBot) -> None:
    panel, menu = window.panels.wavefronts, window.panels.wavefronts.menu
    whole = shown(window).copy()
    choose(qtbot, menu, "Remove", "Z2 tilt along x")
    flat = shown(window).copy()
    assert np.ptp(flat[1, 1, 4]) == pytest.approx(np.ptp(flat[1, 1, 4, :7]))  # symmetric about the middle
    assert np.ptp(whole[1, 1, 4]) > np.ptp(whole[1, 1, 4, :7]) + 1
    choose(qtbot, menu, "Remove", "Z4 defocus")
    np.testing.assert_allclose(shown(window), 0, atol=1e-9)
    assert panel._summary.text().endswith("; no Z2, Z4")
    choose(qtbot, menu, "Remove", "Z4 defocus")
    choose(qtbot, menu, "Remove", "Z2 tilt along x")
    choose(qtbot, menu, "Unit", "nm")
    np.testing.assert_allclose(shown(window), whole * SENSOR.wavelength_m * 1e9 / (2 * np.pi))
    assert panel.grid.maps is not None
    assert panel.grid.maps.scale.title == "nm"
    assert panel._summary.text().endswith(" nm")
    choose(qtbot, menu, "Views", "5 \N{MULTIPLICATION SIGN} 5")
    assert shown(window).shape[:2] == (5, 5)
    qtbot.waitUntil(lambda: len(panel.grid.captions) == 25)
    assert panel.grid.captions[4, 0][1][0] == "x \N{MINUS SIGN}0.50  y +0.50 mm"


def test_fitted_pupil_limits_all_numbers_and_is_drawn_on_the_camera(window: MainWindow, qtbot: QtBot) -> None:
    panel, menu, camera = window.panels.wavefronts, window.panels.wavefronts.menu, window.panels.camera
    camera.show_bench(SENSOR, LATTICE, 65535)
    round_one, inside = bowl(), Pupil.round((0.0, 0.0), 4.2 * SENSOR.lenslet_pitch_m).contains(SENSOR.lenslet_centers_m)
    outcome = np.where(inside, round_one.displacement.outcome, LensletStatus.DARK)
    round_one = replace(round_one, displacement=replace(round_one.displacement, outcome=outcome))
    panel.show_wavefront(round_one)
    choose(qtbot, menu, "Fit a pupil to the valid lenslets")
    pupil = menu.options.pupil
    assert pupil is not None
    assert pupil.radius_m is not None
    assert pupil.radius_m == pytest.approx(4.2 * SENSOR.lenslet_pitch_m, rel=0.05)
    assert window.shown.wavefront is not None
    seen = np.isfinite(window.shown.wavefront.views)
    np.testing.assert_array_equal(seen, np.broadcast_to(pupil.contains(SENSOR.lenslet_centers_m), seen.shape))
    assert panel._summary.text().endswith(pupil.in_words)
    camera.show_numbers()
    assert panel.grid.maps is not None
    x, y = np.transpose(list(panel.grid.maps.outline)) - 0.5  # shares of the map
    widths = SENSOR.lenslets[1] * SENSOR.lenslet_pitch_m, SENSOR.lenslets[0] * SENSOR.lenslet_pitch_m
    np.testing.assert_allclose(np.hypot(x * widths[0], y * widths[1]).max(), pupil.radius_m)
    distance_px = np.hypot(*(camera._pupil.ends - (LATTICE.center_x_px, LATTICE.center_y_px)).T)
    np.testing.assert_allclose(distance_px.max(), pupil.radius_m / SENSOR.lenslet_pitch_m * LATTICE.pitch_px)
    choose(qtbot, menu, "Show all lenslets")
    assert np.isfinite(window.shown.wavefront.views).all()
    camera.show_numbers()
    assert not len(camera._pupil.ends)


def test_menu_of_removed_modes_stays_open_for_the_next(window: MainWindow, qtbot: QtBot) -> None:
    menu = window.panels.wavefronts.menu
    remove = next(action.menu() for action in menu.actions() if action.text() == "Remove")
    assert remove is not None
    remove.popup(QPoint(0, 0))
    for mode in (2, 3):
        click(qtbot, remove, remove.actionGeometry(menu.removed[mode]).center())
    assert remove.isVisible()
    assert menu.options.removed == {2, 3}
    remove.close()


def test_tip_and_tilt_are_removed_in_one_step_and_piston_is_none_to_remove(window: MainWindow) -> None:
    menu = window.panels.wavefronts.menu
    menu.tilt.trigger()
    assert menu.options.removed == {2, 3}
    menu.removed[3].trigger()
    assert not menu.tilt.isChecked()
    menu.tilt.trigger()
    assert menu.options.removed == {2, 3}
    menu.tilt.trigger()
    assert not menu.options.removed
    assert "Piston is not measured" in [each.text() for each in menu.findChildren(QAction)]


def test_stored_wavefront_is_subtracted_until_it_is_cleared(window: MainWindow, qtbot: QtBot) -> None:
    panel, menu = window.panels.wavefronts, window.panels.wavefronts.menu
    assert not menu.clear_stored.isEnabled()
    choose(qtbot, menu, "Subtract the present wavefront")
    np.testing.assert_allclose(shown(window), 0, atol=1e-9)
    assert "; minus that of " in panel._summary.text()
    panel.show_wavefront(bowl(4000.0))
    expected = 1000.0 * SENSOR.pupil_x_m
    np.testing.assert_allclose(shown(window)[1, 1, 4], expected, atol=1e-9)
    choose(qtbot, menu, "Subtract nothing")
    assert np.ptp(shown(window)[1, 1, 4]) > 10


def subtract(path: Path, window: MainWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(path), ""))
    choose(qtbot, window.panels.wavefronts.menu, "Subtract a wavefront from a file…")


def test_wavefront_of_a_file_is_read_beside_the_window_and_subtracted(
    window: MainWindow, qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel, read, go_on = window.panels.wavefronts, StoredWavefront.from_results, threading.Event()
    frame, path = modal(np.full((6, 3), 0.5)), tmp_path / "tilted.nc"
    write_results(path, result_dataset(frame), bench=BENCH, inputs={})

    def read_slowly(*arguments: Any) -> StoredWavefront:
        assert threading.current_thread() is not threading.main_thread()
        assert go_on.wait(HANG_S)
        return read(*arguments)

    monkeypatch.setattr(StoredWavefront, "from_results", read_slowly)
    panel.show_wavefront(frame)
    subtract(path, window, qtbot, monkeypatch)
    assert panel.menu.options.stored is None  # the window goes on
    go_on.set()
    qtbot.waitUntil(lambda: panel.menu.options.stored is not None)
    np.testing.assert_allclose(shown(window), 0, atol=1e-3)  # as the file has it
    assert "; minus tilted.nc" in panel._summary.text()


def test_unsuitable_file_is_refused_in_words(
    window: MainWindow, qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "zonal.nc"
    write_results(path, result_dataset(bowl()), bench=BENCH, inputs={})
    warned = list[str]()
    window.panels.wavefronts.warned.connect(warned.append)
    subtract(path, window, qtbot, monkeypatch)
    qtbot.waitUntil(lambda: bool(warned))
    assert "zonal.nc: holds no coefficients" in warned[0]
    assert window.panels.wavefronts.menu.options.stored is None


def test_options_apply_to_analysed_quantities(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.wavefronts
    for mode in (2, 3, 4):
        panel.menu.removed[mode].setChecked(True)
    panel.choice.setCurrentText(Quantity.PSF)
    qtbot.waitUntil(lambda: panel.grid.maps is not None)
    maps = shown(window)
    assert maps[1, 1, maps.shape[2] // 2, maps.shape[3] // 2] == pytest.approx(1)  # nothing is left of the bowl


def test_double_click_opens_the_enlarged_view(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.wavefronts
    corner = panel.grid.places.tile(2, 0).center()
    click(qtbot, panel.grid, corner)
    qtbot.mouseDClick(panel.grid, Qt.MouseButton.LeftButton, pos=corner)  # type: ignore[no-untyped-call] # pytest-qt declares no types
    enlarged = window.findChild(EnlargedView)
    assert enlarged is not None
    assert enlarged.isVisible()
    np.testing.assert_array_equal(enlarged.map.values, shown(window)[2, 0])
    tile = enlarged.map.places.tile(0, 0)
    click(qtbot, enlarged.map, tile.topLeft() + QPoint(tile.width() * 5 // 26, tile.height() * 3 // 18))
    assert enlarged.map.at == (1, 2)
    for key in (Qt.Key.Key_Down, Qt.Key.Key_Right):
        press(qtbot, enlarged.map, key)
    assert enlarged.text.text().startswith("Lenslet row 2, column 3: ")
    x, across = enlarged._curves[0].getData()
    np.testing.assert_allclose(x, SENSOR.pupil_x_m * 1e3)
    np.testing.assert_array_equal(across, shown(window)[2, 0, 2])
    np.testing.assert_array_equal(enlarged._curves[1].getData()[1], shown(window)[2, 0, :, 3])
    panel.show_wavefront(bowl(5000.0))
    np.testing.assert_array_equal(enlarged.map.values, shown(window)[2, 0])
    panel.show_wavefront(None)
    assert enlarged.text.text() == "No wavefront"


def test_enlarged_view_paints_contours(window: MainWindow) -> None:
    window.panels.wavefronts.enlarge()
    enlarged = window.findChild(EnlargedView)
    assert enlarged is not None
    QApplication.processEvents()
    with_contours = part(picture(enlarged.map), enlarged.map.places.tile(0, 0)).astype(int)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("app.gui.widgets.enlarged_view.contours", lambda *_: [])
        without = part(picture(enlarged.map), enlarged.map.places.tile(0, 0)).astype(int)
    changed = np.abs(with_contours - without).max(axis=2) > 30
    assert 0.01 < changed.mean() < 0.3


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (4.207, "4.21"),
        (0.9996, "1.00"),
        (0.0123456, "0.0123"),
        (-0.00045678, "\N{MINUS SIGN}0.000457"),
        (1234.0, "1230"),
        (3.2e-9, "3.2e\N{MINUS SIGN}09"),
        (-1e308, "\N{MINUS SIGN}1.0e+308"),
        (float("nan"), "\N{EN DASH}"),
    ],
)
def test_numbers_have_significant_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_signed_numbers() -> None:
    assert [signed(value) for value in (0.5, -0.5, 0.0)] == ["+0.500", "\N{MINUS SIGN}0.500", "0"]


def test_columns_of_hexagonal_maps_are_straight(make_window: MakeWindow) -> None:
    sensor = replace(SENSOR, arrangement="hexagonal")
    x_m = sensor.lenslet_centers_m[..., 0]
    window, tilted = make_window(), bowl()
    window.shown.reconstruction = BENCH.reconstruction
    views = np.broadcast_to(1e3 * x_m, (3, 3, *x_m.shape))
    window.panels.wavefronts.show_wavefront(
        Wavefront(sensor, tilted.field, tilted.displacement, tilted.solution, views, FREE)
    )
    maps = window.panels.wavefronts.grid.maps
    assert maps is not None
    half_m = (sensor.lenslets[1] - 1) / 2 * sensor.lenslet_pitch_m
    np.testing.assert_allclose(maps.values[1, 1, :, -1], 1e3 * half_m, rtol=1e-6)
    half_high_m = (sensor.lenslets[0] - 1) / 2 * sensor.lenslet_pitch_m * math.sqrt(3) / 2
    assert maps.reach == pytest.approx((1e3 * half_m, 1e3 * half_high_m))


def test_rms_below_its_noise_is_no_number(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    panel = window.panels.wavefronts
    coefficients = np.zeros((10, 3))
    coefficients[4, 0] = 1e-5
    for tilt_rad, is_below in ((1e-5, True), (1.0, False)):
        coefficients[1, 0] = tilt_rad
        wavefront = modal(coefficients)
        panel.show_wavefront(wavefront)
        noise_rad = float(np.sqrt(np.mean(wavefront.sigma() ** 2)))
        below = f"Mean RMS below noise ({number(noise_rad)} rad)"

        def is_judged(below: str = below, *, is_below: bool = is_below) -> bool:
            panel.show_numbers()
            return (panel._summary.text() == below) == is_below

        qtbot.waitUntil(is_judged)
        assert panel._summary.text().startswith("Mean RMS")


def edit_limit(qtbot: QtBot, panel: WavefrontPanel) -> None:
    """Click on the colour bar."""
    assert panel.grid.maps is not None
    click(qtbot, panel.grid, panel.grid._bar(panel.grid.maps).center())
    panel.limit.selectAll()


def test_limit_of_the_colours_has_the_unit(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.wavefronts
    choose(qtbot, panel.menu, "Unit", "nm")
    edit_limit(qtbot, panel)
    QTest.keyClicks(panel.limit, "250\r")  # type: ignore[call-arg, arg-type] # PyQt's stub lacks staticmethod
    assert panel.grid.maps is not None
    assert panel.grid.maps.scale.high == 250
    assert panel.grid.maps.scale.title == "nm fixed"


def test_lenslet_that_was_not_measured_is_hatched(window: MainWindow) -> None:
    outcome = np.zeros(LENSLETS, np.int8)
    outcome[2, 3] = LensletStatus.EXCLUDED
    known = views()
    window.show_measurement(make_measurement(dim_frame(), known, outcome=outcome))
    window.update_text()
    maps = window.panels.wavefronts.grid.maps
    assert np.isfinite(known).all()  # as the modes continue it
    assert maps is not None
    assert np.argwhere(np.isnan(maps.values[1, 1])).tolist() == [[2, 3]]
    assert maps.describe(2, 3, float(maps.values[1, 1, 2, 3])) == "Lenslet row 2, column 3: lost, no value"
