"""Quantities over the field, the selected view, and the plots below the camera."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from PyQt6.QtCore import QPoint, Qt
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FIELD, SENSOR, FakeCamera, make_measurement
from support.patience import HANG_S
from support.wavefronts import bowl
from support.window_tools import LENSLETS, MakeWindow, click, dim_frame, part, picture, press, views, wait_for_wavefront

from app.gui.panels.quality import verdict
from app.gui.panels.wavefronts import WavefrontPanel
from app.gui.shell.main_window import MainWindow
from app.gui.widgets.enlarged_view import EnlargedView
from app.gui.widgets.presentation import PRESENTATIONS, colour_table, number
from app.results.view_maps import Quantity, QuantityMaps, quantity_maps
from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus
from reconstruction.quality.isoplanatism import Isoplanatism, StructureCurve
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Wavefront, rms

KEYS = (Qt.Key.Key_1, Qt.Key.Key_2, Qt.Key.Key_3, Qt.Key.Key_4, Qt.Key.Key_5)


def shown(window: MainWindow) -> Floats:
    maps = window.panels.wavefronts.grid.maps
    assert maps is not None
    return maps.values


def is_shown(window: MainWindow, quantity: Quantity) -> bool:
    numbers = window.panels.wavefronts._numbers
    return numbers is not None and numbers.quantity is quantity


def show(window: MainWindow, wavefront: Wavefront | None) -> None:
    """Show a wavefront as the window does, without a camera."""
    window.shown.reconstruction = BENCH.reconstruction
    window.panels.wavefronts.show_wavefront(wavefront)


@pytest.mark.slow
@pytest.mark.long
def test_keys_choose_the_quantity(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.activateWindow()
    panel = window.panels.wavefronts
    for key, quantity, shape, caption in (
        (KEYS[1], Quantity.PSF, None, "Strehl"),
        (KEYS[2], Quantity.RESIDUAL, LENSLETS, "RMS"),
        (KEYS[3], Quantity.UNCERTAINTY, LENSLETS, "mean"),
        (KEYS[0], Quantity.WAVEFRONT, LENSLETS, "RMS"),
    ):
        press(qtbot, window, key)
        assert panel.quantity is quantity
        qtbot.waitUntil(partial(is_shown, window, quantity))
        maps = shown(window)
        assert maps.shape[:2] == (3, 3)
        assert shape in (None, maps.shape[2:])
        assert all(lines[0][0].startswith(caption) for lines in panel.grid.captions.values())
        assert panel.grid.captions[0, 2][1][0] == "x +0.50  y \N{MINUS SIGN}0.50 mm"
        assert panel._summary.text()


def test_quality_says_which_wavefront_each_of_its_numbers_is_of(make_window: MakeWindow, qtbot: QtBot) -> None:
    """The display options apply to the MTF; the single correction is that of the whole wavefront."""
    window = make_window()
    menu, quality = window.panels.wavefronts.menu, window.panels.quality
    show(window, bowl())
    qtbot.waitUntil(lambda: quality.mtf.title.text() == "MTF at 0, 0 mm")
    before = quality.sentence.text()
    assert before.startswith("A single correction would leave ")
    menu.store.trigger()
    assert menu.options.stored is not None
    name = menu.options.stored.name
    qtbot.waitUntil(lambda: quality.mtf.title.text() == f"MTF at 0, 0 mm, minus {name}")
    assert quality.sentence.text() == f"Of the wavefronts as measured: {before[0].lower()}{before[1:]}"
    menu.clear_stored.trigger()
    qtbot.waitUntil(lambda: quality.sentence.text() == before)


def test_psf_peaks_in_the_middle_and_caption_states_strehl(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    window.panels.wavefronts.choice.setCurrentText(Quantity.PSF)
    flat = bowl()
    flat.views[:] = 0.0
    flat.views[2, 0] = np.nan
    show(window, flat)
    qtbot.waitUntil(lambda: window.panels.wavefronts.grid.maps is not None)
    maps = shown(window)
    assert maps.shape[2] == maps.shape[3]
    middle = maps.shape[2] // 2
    assert maps[1, 1, middle, middle] == maps[1, 1].max() == pytest.approx(1)
    captions = window.panels.wavefronts.grid.captions
    assert captions[1, 1][0] == ("Strehl 1.00, peak 1.00", "Strehl 1.00", "1.00", "1.00", "1.00")
    assert captions[2, 0][0][1] == "Strehl \N{EN DASH}"
    grid = window.panels.wavefronts.grid
    seen = picture(grid).astype(int)
    bright_tile, lost_tile = part(seen, grid.places.tile(1, 1)), part(seen, grid.places.tile(2, 0))
    assert bright_tile[bright_tile.shape[0] // 2, bright_tile.shape[1] // 2].min() > 130
    assert bright_tile[:5, :5].max() < 60
    assert 30 < lost_tile.mean() < 80  # hatched
    assert "of the peak without aberration" in grid._value_at(grid.places.tile(1, 1).center())
    assert grid.maps is not None
    reach_mrad = grid.maps.reach[0]
    at = grid._value_at(grid.places.tile(1, 1).topRight())
    assert at.startswith(f"{reach_mrad:+.2f}, {-reach_mrad:+.2f} mrad: ")  # x, y


def test_clicks_and_arrow_keys_select_the_view_of_the_mtf(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    show(window, bowl())
    grid, mtf = window.panels.wavefronts.grid, window.panels.quality.mtf
    qtbot.waitUntil(lambda: mtf.title.text() == "MTF at 0, 0 mm")
    click(qtbot, grid, grid.places.tile(0, 2).center())
    qtbot.waitUntil(lambda: mtf.title.text() == "MTF at +0.50, \N{MINUS SIGN}0.50 mm")
    for key in (Qt.Key.Key_Up, Qt.Key.Key_Right, Qt.Key.Key_Down, Qt.Key.Key_Left):  # the first two have no effect
        press(qtbot, grid, key)
    qtbot.waitUntil(lambda: mtf.title.text() == "MTF at 0, 0 mm")
    x, y = mtf._limits[0].getData()
    np.testing.assert_allclose(y, 1 - x / x[-1], atol=1e-6)
    assert x[-1] == pytest.approx(13 * 500e-6 / 462e-9 / 1e3)  # cycles per mrad
    assert mtf._limits[1].getData()[0][-1] == pytest.approx(9 * 500e-6 / 462e-9 / 1e3)
    blue = picture(grid).astype(int)
    frame = grid.places.tile(1, 1).adjusted(-1, -1, 1, 1)
    assert blue[frame.top(), frame.center().x(), 2] > blue[frame.top(), frame.center().x(), 0] + 60


def test_hidden_panel_requests_no_analysis(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    dock = next(one for one in window.docks.docks if one.panel is window.panels.quality)
    dock.close()
    assert not window.panels.quality.isVisible()
    show(window, bowl())
    qtbot.wait(200)
    assert window.analyses.of[window.panels.quality].request is None
    dock.show()
    dock.raise_()
    qtbot.waitUntil(lambda: bool(window.panels.quality.sentence.text()))


def test_lost_wavefront_clears_maps_and_plots(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    show(window, bowl())
    window.panels.wavefronts.choice.setCurrentText(Quantity.PSF)
    panel = window.panels.quality
    qtbot.waitUntil(lambda: window.panels.wavefronts._numbers is not None and bool(panel.sentence.text()))
    show(window, None)
    qtbot.wait(100)
    assert window.panels.wavefronts.grid.maps is None
    assert panel.sentence.text() == ""
    assert panel.mtf.title.text() == "MTF"
    for curve in (*panel.mtf._curves, *(item for items in panel.structure._curves for item in items)):
        assert len(curve.getData()[0]) == 0


def test_views_without_values_are_shown_for_every_quantity(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    displacement = bowl().displacement
    lost = replace(displacement, outcome=np.full_like(displacement.outcome, LensletStatus.DIVERGED))
    unknown = Wavefront.of(SENSOR, FIELD, lost, ZonalSolution(SENSOR, lost))
    show(window, unknown)
    panel = window.panels.wavefronts
    analysis = window.analyses.of[panel]

    def is_analysed(quantity: Quantity) -> bool:
        if analysis.is_busy or quantity is Quantity.WAVEFRONT:
            return not analysis.is_busy
        return analysis.request is not None and analysis.request.choice[0] is quantity  # type: ignore[index] # a tuple

    for quantity in Quantity:
        window.panels.wavefronts.choice.setCurrentText(quantity)
        qtbot.waitUntil(partial(is_analysed, quantity))
        picture(window)
    assert window.panels.quality.sentence.text() == "No lenslet is valid over the whole field"


def test_failing_analysis_is_shown_and_window_continues(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    measurement = make_measurement(dim_frame(), views())  # its solution cannot be evaluated
    window.shown.reconstruction = BENCH.reconstruction
    window.show_measurement(measurement)
    qtbot.waitUntil(lambda: "Analysis failed" in window.messages._notice)
    assert window.panels.wavefronts.grid.maps is not None


@pytest.mark.slow
@pytest.mark.long
def test_redraw_continues_while_analysis_hangs_and_thread_ends_with_window(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    window.panels.wavefronts.choice.setCurrentText(Quantity.PSF)
    qtbot.waitUntil(
        lambda: window.panels.wavefronts._numbers is not None and bool(window.panels.quality.sentence.text())
    )
    hangs, may_go_on = threading.Event(), threading.Event()

    def hang(*arguments: Any) -> QuantityMaps | None:
        hangs.set()
        assert may_go_on.wait(HANG_S)
        return quantity_maps(*arguments)

    monkeypatch.setattr("app.gui.panels.wavefronts.quantity_maps", hang)
    qtbot.waitUntil(hangs.is_set)
    before = window.status_line.shown
    qtbot.waitUntil(lambda: window.status_line.shown > before + 15)
    may_go_on.set()
    window.close()
    analyses = window.analyses.of.values()
    assert not any(one.is_alive() for analysis in analyses for one in analysis.thread._threads)


def test_frozen_scale_keeps_colours_and_reach(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    panel = window.panels.wavefronts
    panel.choice.setCurrentText(Quantity.PSF)
    show(window, bowl())
    qtbot.waitUntil(lambda: panel.grid.maps is not None)
    panel.fix_scale.setChecked(True)
    assert panel.grid.maps is not None
    scale, reach_mrad = panel.grid.maps.scale, panel._reach_mrad.value
    show(window, bowl(tilt_rad_per_m=8000.0))
    qtbot.wait(600)
    assert panel.grid.maps.scale == scale
    assert panel._reach_mrad.value == reach_mrad
    panel.fix_scale.setChecked(False)
    show(window, bowl(tilt_rad_per_m=8000.0))
    qtbot.waitUntil(lambda: panel._reach_mrad.value != reach_mrad)


def test_limit_is_typed_on_the_bar_and_fixes_the_scale(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    panel = window.panels.wavefronts
    window.show_measurement(make_measurement(dim_frame(), views()))
    assert not panel.limit.isVisible()
    edit_limit(qtbot, panel)
    maps = panel.grid.maps
    assert maps is not None
    assert panel.limit.value() == maps.scale.high != 2.5
    qtbot.keyClicks(panel.limit, "2.5")  # type: ignore[no-untyped-call] # pytest-qt declares no types for it
    press(qtbot, panel.limit, Qt.Key.Key_Return)
    assert not panel.limit.isVisible()
    assert panel.fix_scale.isChecked()
    window.show_measurement(make_measurement(dim_frame(), 3 * views()))
    assert panel.grid.maps is not None
    assert (panel.grid.maps.scale.high, panel.grid.maps.scale.title) == (2.5, "rad fixed")
    panel.fix_scale.trigger()
    window.show_measurement(make_measurement(dim_frame(), 3 * views()))
    assert panel.grid.maps.scale.high > 2.5


def edit_limit(qtbot: QtBot, panel: WavefrontPanel) -> None:
    """Click on the colour bar."""
    assert panel.grid.maps is not None
    click(qtbot, panel.grid, panel.grid._bar(panel.grid.maps).center())
    assert panel.limit.isVisible()
    panel.limit.selectAll()


def with_errors(wavefront: Wavefront, sigma_rad: Floats) -> Wavefront:
    return replace(wavefront, sigma_source=lambda: sigma_rad)  # type: ignore[arg-type] # a stand-in


def test_tiles_show_the_error_and_hatch_what_is_not_well_known(make_window: MakeWindow, qtbot: QtBot) -> None:
    """A value is hatched where its error exceeds a tenth of the value of its view."""
    window = make_window()
    panel, wavefront = window.panels.wavefronts, bowl()
    value_rad = float(rms(wavefront.views)[0, 0])
    sigma_rad = np.full(wavefront.views.shape, 0.05 * value_rad)
    sigma_rad[0, 0, 2, 5] = 0.11 * value_rad
    show(window, with_errors(wavefront, sigma_rad))
    qtbot.waitUntil(lambda: panel._numbers is not None and panel._numbers.sigma_rad is not None)
    show(window, with_errors(wavefront, sigma_rad))  # the next frame
    panel.show_numbers()
    maps = panel.grid.maps
    assert maps is not None
    assert maps.unsure is not None
    assert np.argwhere(maps.unsure).tolist() == [[0, 0, 2, 5]]
    tile = panel.grid.places.tile(0, 0)
    at = QPoint((2 * 5 + 1) * tile.width() // (2 * 13), (2 * 2 + 1) * tile.height() // (2 * 9))  # of 9 x 13 lenslets
    under_cursor = f" \N{PLUS-MINUS SIGN} {number(0.11 * value_rad, 2)} rad"
    assert panel.grid._value_at(tile.topLeft() + at).splitlines()[0].endswith(under_cursor)
    heads, *rows = panel.grid.table().splitlines()
    assert heads.endswith("value (rad)\tstandard deviation (rad)")
    np.testing.assert_allclose([float(row.split("\t")[-1]) for row in rows], sigma_rad.ravel(), rtol=1e-6)
    panel.grid.selected.emit(1, 1)
    panel.enlarge()
    panel.grid.select((1, 1))
    enlarged = window.findChild(EnlargedView)
    assert enlarged is not None
    enlarged.refresh()
    assert enlarged.map.maps is not None
    assert enlarged.map.maps.unsure is not None
    assert not enlarged.map.maps.unsure.any()  # those of the first view are not its own
    assert f" \N{PLUS-MINUS SIGN} {number(0.05 * value_rad, 2)} rad; contours" in enlarged.text.text()
    error = number(0.05 * value_rad, 1)
    assert panel.grid.captions[1, 1][0][2].endswith(f" \N{PLUS-MINUS SIGN} {error} rad")
    mean_rad = np.sqrt((sigma_rad**2).mean(axis=(2, 3))).mean()
    assert window.shown.sigma_rad == pytest.approx(mean_rad)


def curve(*rms_rad: float) -> StructureCurve:
    values = np.array(rms_rad)
    return StructureCurve(np.linspace(1e-4, len(rms_rad) * 1e-4, len(rms_rad)), values, values, values)


def test_verdict_states_error_and_patch() -> None:
    found = Isoplanatism(curve(0.5, 1.5), curve(0.1, 0.2), 0.42, 0.1, np.zeros((3, 3)))
    assert verdict(found) == "A single correction would leave 0.42 rad RMS. Isoplanatic patch: 0.15 mm"
    wide = Isoplanatism(curve(0.1, 0.2), curve(0.1, 0.2), 0.04, 0.01, np.zeros((3, 3)))
    assert verdict(wide).endswith("would leave 0.040 rad RMS. Isoplanatic patch: wider than the field")
    constant = Isoplanatism(curve(0.0, 0.0), curve(0.0, 0.0), 7.6e-16, 0.0, np.zeros((3, 3)))
    assert verdict(constant).startswith("A single correction would leave 0 rad RMS.")


def test_colours_run_from_low_to_high_and_nan_is_transparent() -> None:
    diverging, uncertain, bright = (
        PRESENTATIONS[quantity].scale for quantity in (Quantity.WAVEFRONT, Quantity.UNCERTAINTY, Quantity.PSF)
    )
    for scale, middle in ((diverging(2.0, "rad"), 0.0), (uncertain(2.0, "rad"), 1.0), (bright(2.0, ""), 0.5)):
        pixels = scale.pixels(np.array([scale.low - 1, scale.low, middle, 2.0, 3.0, np.nan]))
        bar = colour_table(scale.colours)
        np.testing.assert_array_equal(pixels, [bar[0], bar[0], bar[len(bar) // 2], bar[-1], bar[-1], 0])
    assert [text for _, text in bright(0.2, "").ticks] == ["0", "0.02", "0.05", "0.1", "0.2"]
    np.testing.assert_allclose([at for at, _ in bright(0.2, "").ticks], np.sqrt([0, 0.1, 0.25, 0.5, 1]))
    assert diverging(1.5, "rad").ticks[0] == (0.0, "\N{MINUS SIGN}1.5")


def test_space_variant_sample_leaves_an_error_of_single_correction(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window(FakeCamera())
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    sentence = window.panels.quality.sentence
    qtbot.waitUntil(lambda: sentence.text().startswith("A single correction"))
    assert float(sentence.text().partition("leave ")[2].partition(" rad")[0]) > 0.1
