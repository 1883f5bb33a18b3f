"""Tabs of coefficients and history."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PyQt6.QtCore import QPoint, QPointF, Qt
from PyQt6.QtWidgets import QApplication, QFileDialog
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, make_measurement
from support.wavefronts import modal
from support.window_tools import MakeWindow, click, dim_frame, tab, views

from app.gui.panels.coefficients import CoefficientsPanel
from app.gui.panels.history import _ticks
from app.gui.panels.panel import Panel
from app.gui.shell.main_window import MainWindow
from app.measurement.measurement import Measurement
from app.results.history import DELAY, RMS, TEMPERATURE, sample
from app.results.shown_wavefront import Unit


def measurement(defocus: float) -> Measurement:
    """Legendre P2(x) of the given size and a growth of P1(y) over the field's x."""
    coefficients = np.zeros((6, 3))
    coefficients[3, 0], coefficients[2, 1] = defocus, 0.4
    return replace(make_measurement(dim_frame(), views()), wavefront=modal(coefficients))


def record(window: MainWindow) -> None:
    assert window.shown.measurement is not None
    found = sample(window.shown.measurement, window.shown.wavefront, full_scale=65535, temperature_c=-60.0)
    window.panels.history.show_result(found)


def open_tab(window: MainWindow, title: str) -> None:
    bar, at = tab(window, title)
    QtBot.mouseClick(bar, Qt.MouseButton.LeftButton, pos=at)  # type: ignore[no-untyped-call] # pytest-qt declares no types


@pytest.fixture
def window(make_window: MakeWindow, qtbot: QtBot) -> MainWindow:
    made = make_window()
    made.shown.reconstruction = BENCH.reconstruction
    made.show_measurement(measurement(0.5))
    open_tab(made, "Coefficients")
    panel = made.panels.coefficients
    panel.basis.setCurrentText("Legendre")
    qtbot.waitUntil(lambda: panel._found is not None and panel._found.choice.basis == "legendre")
    return made


def click_bar(panel: CoefficientsPanel, mode: int) -> None:
    QApplication.processEvents()
    scene = panel.plot.view.mapViewToScene(QPointF(mode, 0.0))
    at = panel.plot.graphics.mapFromScene(scene)
    QtBot.mouseClick(panel.plot.graphics.viewport(), Qt.MouseButton.LeftButton, pos=QPoint(at.x(), at.y()))  # type: ignore[no-untyped-call] # pytest-qt declares no types


def test_bars_are_the_coefficients_of_the_selected_view(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.coefficients
    height = np.asarray(panel._bars.opts["height"])
    np.testing.assert_allclose(height[[1, 2]], [0, 0.5], atol=1e-4)
    ends = panel._errors.getData()[1].reshape(-1, 2)
    np.testing.assert_allclose(ends.mean(axis=1), height, atol=1e-9)
    assert (np.ptp(ends, axis=1)[:5] > 1e-3).all()  # the modes of the reconstruction
    grid = window.panels.wavefronts.grid
    click(qtbot, grid, grid.places.tile(1, 2).center())  # x = +0.5 mm of 0.6
    qtbot.waitUntil(lambda: panel._found is not None and panel._found.choice.view == (1, 2))
    np.testing.assert_allclose(panel._bars.opts["height"][1], 0.4 * 0.5 / 0.6, atol=1e-4)
    panel.of.setCurrentIndex(2)
    qtbot.waitUntil(lambda: panel._found is not None and panel._found.choice.field_mode == 1)
    np.testing.assert_allclose(panel._bars.opts["height"][[1, 2]], [0.4, 0], atol=1e-4)


def test_click_on_a_bar_maps_and_records_it_until_the_next_click(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.coefficients
    assert panel.map.maps is None
    click_bar(panel, 2)
    qtbot.waitUntil(lambda: panel.map.maps is not None)
    assert panel.map.maps is not None
    np.testing.assert_allclose(panel.map.maps.values[0, 0, 5], np.linspace(-0.4, 0.4, 21), atol=1e-4)
    assert panel.name == "L2 P1(y), view"
    assert panel.plot.title.text().endswith(" rad, L2 P1(y)")  # the numbers come first: a narrow panel cuts the name
    open_tab(window, "History")  # the pinned coefficient is still computed
    for defocus in (0.5, 0.6):
        before = panel._found
        window.show_measurement(measurement(defocus))
        qtbot.waitUntil(lambda before=before: panel._found is not before)
        record(window)
    time_s, values = window.panels.history.history.series("L2 P1(y), view")
    np.testing.assert_allclose(values, 0, atol=1e-4)
    assert len(values) == 2
    assert time_s[0] < 0 == time_s[1]
    assert list(window.panels.history.charts) == ["L2 P1(y), view", RMS]
    open_tab(window, "Coefficients")
    click_bar(panel, 2)
    assert panel.name == ""
    assert panel.map.maps is None
    assert list(window.panels.history.charts) == [RMS]


def test_history_charts_are_chosen_and_share_the_time_axis(window: MainWindow) -> None:
    history = window.panels.history
    open_tab(window, "History")
    for name in (DELAY, TEMPERATURE):
        history.toggles[name].trigger()
    for index in range(5):
        history.add(10.0 * index, {RMS: 1.0 + index, DELAY: 4.0, TEMPERATURE: -65.0})
    assert list(history.charts) == [RMS, DELAY, TEMPERATURE]
    QApplication.processEvents()
    for name, chart in history.charts.items():
        minutes, values = chart.curve.getData()
        np.testing.assert_allclose(minutes, np.arange(-4, 1) / 6)
        np.testing.assert_array_equal(values, history.history.series(name)[1])
        assert chart.plot.view.viewRange()[0] == pytest.approx([-2, 0])
    texts = [chart.value.text() for chart in history.charts.values()]
    assert texts == ["5.00 rad", "4.00 ms", "\N{MINUS SIGN}65.0 \N{DEGREE SIGN}C"]
    stacked = [chart.mapTo(history, QPoint()).y() for chart in history.charts.values()]
    assert stacked == sorted(set(stacked))
    assert len({chart.height() for chart in history.charts.values()}) <= 2  # but for a rounded pixel
    axes = [history.time_axis, *(chart.plot for chart in history.charts.values())]
    edges = {(plot.mapTo(history, QPoint()).x(), plot.view.sceneBoundingRect().getRect()[::2]) for plot in axes}
    assert len(edges) == 1  # a time is at the same place in all
    assert history.time_axis.axes["bottom"].range == pytest.approx([-2, 0])
    assert all(chart.value.width() >= chart.value.sizeHint().width() for chart in history.charts.values())


def test_history_shows_the_drift_of_the_time_shown_and_exports_it(
    window: MainWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    history = window.panels.history
    open_tab(window, "History")
    for index in range(120):
        history.add(float(index), {RMS: 100.0 if index < 20 else 2.0 + (index % 2)})
    history.minutes.setCurrentIndex(history.minutes.findData(1))
    mean, sigma, peak_to_peak = history.charts[RMS].drift.text().split(", ")
    assert (mean, sigma, peak_to_peak) == ("mean 2.508", "\N{GREEK SMALL LETTER SIGMA} 0.50", "peak to peak 1.0")
    history.minutes.setCurrentIndex(history.minutes.findData(2))
    assert history.charts[RMS].drift.text().endswith("peak to peak 98")
    save_csv(window, history, tmp_path / "drift", monkeypatch)
    qtbot.waitUntil((tmp_path / "drift.csv").exists)
    assert len((tmp_path / "drift.csv").read_text().splitlines()) == 121


def test_history_has_a_gap_at_a_pause_and_ticks_that_differ(window: MainWindow) -> None:
    history = window.panels.history
    open_tab(window, "History")
    for time_s, value in ((0.0, 2.0611), (0.2, 2.0612), (9.0, 2.0613), (9.2, 2.0614)):
        history.add(time_s, {RMS: value})
    chart = history.charts[RMS]
    assert chart.curve.opts["connect"].tolist() == [1, 0, 1, 0]
    chart.plot.resize(400, 200)
    assert [text for _, text in _ticks(2.0611, 2.0614)] == ["2.0611", "2.0614"]


def test_history_of_phases_follows_the_unit(window: MainWindow) -> None:
    history = window.panels.history
    open_tab(window, "History")
    history.toggles[DELAY].trigger()
    for unit, per_rad in ((0, 1.0), (1, 1 / (2 * np.pi)), (2, 462 / (2 * np.pi))):
        window.panels.wavefronts.menu.units[unit].trigger()
        window.show_measurement(measurement(0.5))
        record(window)
        rms_rad = history.history.series(RMS)[1][-1]
        value, name = history.charts[RMS].value.text().split(" ")
        assert name == window.panels.wavefronts.menu.unit
        assert float(value) == pytest.approx(rms_rad * per_rad, rel=5e-3)
        assert history.charts[RMS].curve.getData()[1][-1] == pytest.approx(rms_rad * per_rad)
        assert history.charts[DELAY].value.text() == "4.00 ms"


def test_table_has_every_mode_with_its_error(window: MainWindow, qtbot: QtBot) -> None:
    panel = window.panels.coefficients
    window.panels.wavefronts.menu.units[2].trigger()
    assert window.panels.wavefronts.menu.unit is Unit.NM
    window.show_measurement(measurement(-0.5))
    qtbot.waitUntil(lambda: panel.plot.title.text().startswith("Coefficients (nm)"))
    click(qtbot, panel.table_toggle, panel.table_toggle.rect().center())
    heads = [panel.numbers.horizontalHeaderItem(at) for at in range(3)]
    assert [head and head.text() for head in heads] == ["mode", "nm", "1\N{GREEK SMALL LETTER SIGMA}"]
    name, value, sigma = (panel.numbers.item(2, at) for at in range(3))
    assert name is not None
    assert value is not None
    assert sigma is not None
    assert name.text() == "L3 P2(x)"
    number = float(value.text().replace("\N{MINUS SIGN}", "-"))
    assert number == pytest.approx(-0.5 * 462 / (2 * np.pi), abs=0.05)
    assert sigma.text()
    assert panel._found is not None
    assert panel.numbers.rowCount() == len(panel._found.names) - 1
    viewport, at = panel.numbers.viewport(), panel.numbers.visualItemRect(name).center()
    assert viewport is not None
    for pinned in ("L3 P2(x), view", ""):  # a click as on its bar
        click(qtbot, viewport, at)
        assert panel.name == pinned


def save_csv(window: MainWindow, panel: Panel, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Choose the entry of the panel's own menu."""
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(path), ""))
    menu = next(dock for dock in window.docks.docks if dock.panel is panel).more.menu()
    assert menu is not None
    menu.aboutToShow.emit()
    next(action for action in menu.actions() if action.text() == "Save the numbers as CSV…").trigger()


def test_maps_and_coefficients_are_saved_as_csv(
    window: MainWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    grid, panel = window.panels.wavefronts.grid, window.panels.coefficients
    assert grid.maps is not None
    save_csv(window, window.panels.wavefronts, tmp_path / "maps", monkeypatch)
    qtbot.waitUntil((tmp_path / "maps.csv").exists)
    heads, *rows = csv.reader((tmp_path / "maps.csv").read_text().splitlines())
    assert heads == ["view row", "view column", "row", "column", "value (rad)"]
    values = np.full(grid.maps.values.shape, np.nan)
    for row in rows:
        values[tuple(map(int, row[:4]))] = float(row[4])
    np.testing.assert_allclose(values, grid.maps.values, rtol=1e-6, atol=1e-9)
    save_csv(window, panel, tmp_path / "modes.csv", monkeypatch)
    qtbot.waitUntil((tmp_path / "modes.csv").exists)
    heads, *rows = csv.reader((tmp_path / "modes.csv").read_text().splitlines())
    assert heads == ["mode", "value (rad)", "standard deviation (rad)"]
    found = panel._found
    assert found is not None
    assert [row[0] for row in rows] == list(found.names[1:])
    np.testing.assert_allclose([float(row[1]) for row in rows], found.rad[1:], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose([float(row[2]) for row in rows], found.sigma_rad[1:], rtol=1e-6)
