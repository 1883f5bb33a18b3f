"""Redraws: hidden panels compute nothing, and what is unchanged is neither computed nor painted again."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from PyQt6.QtCore import QEvent, QObject
from PyQt6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FULL_SCALE, LATTICE, SENSOR, make_measurement
from support.window_tools import MakeWindow, dim_frame, tabs, views

from app.gui.panels import camera, coefficients, quality, wavefronts
from app.gui.shell.main_window import MainWindow
from app.gui.widgets import camera_image
from app.gui.widgets.texts import ElidedLabel
from app.results.pictures import Pixels
from app.results.view_maps import Quantity


class Calls:
    """Counts the calls of functions that it replaces."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._monkeypatch, self.made = monkeypatch, Counter[str]()

    def count(self, module: object, name: str) -> None:
        function: Callable[..., Any] = getattr(module, name)

        def counted(*arguments: Any, **named: Any) -> Any:
            self.made[name] += 1
            return function(*arguments, **named)

        self._monkeypatch.setattr(module, name, counted)


class Paints(QObject):
    """Counts the paint events of each widget."""

    def __init__(self) -> None:
        super().__init__()
        self.of = Counter[QWidget]()

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        if event is not None and event.type() == QEvent.Type.Paint and isinstance(watched, QWidget):
            self.of[watched] += 1
        return False


@pytest.fixture
def window(make_window: MakeWindow) -> MainWindow:
    made: MainWindow = make_window()
    made.panels.camera.show_bench(SENSOR, LATTICE, FULL_SCALE)
    made.show_measurement(make_measurement(dim_frame(), views()))
    settle(made)
    return made


@pytest.fixture
def paints(qapp: QApplication) -> Iterator[Paints]:
    made = Paints()
    qapp.installEventFilter(made)
    yield made
    qapp.removeEventFilter(made)


def settle(window: MainWindow) -> None:
    """Wait until all that is requested is computed, shown and painted."""
    for _ in range(3):
        window.analyses.poll()
        while any(analysis.is_busy for analysis in window.analyses.of.values()):
            time.sleep(0.01)
            window.analyses.poll()
        window.update_text()
        QApplication.processEvents()


def test_hidden_panels_compute_nothing(window: MainWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = Calls(monkeypatch)
    for module, name in (
        (quality, "mtf"),
        (quality, "isoplanatism"),
        (coefficients, "mode_coefficients"),
        (camera, "frame_statistics"),
        (camera_image, "arrows"),
        (camera_image, "count_colours"),
        (wavefronts, "view_numbers"),
        (wavefronts, "quantity_maps"),
    ):
        calls.count(module, name)
    for dock in window.docks.docks:
        dock.hide()
    window.shown.reconstruction = BENCH.reconstruction
    window.panels.wavefronts.choice.setCurrentText(Quantity.PSF)
    for seed in range(3):
        window.show_measurement(make_measurement(dim_frame(), views(seed)))
        settle(window)
    assert calls.made == Counter()
    for panel in (window.panels.camera, window.panels.wavefronts, tabs(window)["Quality"]):
        panel.front_requested.emit()
    settle(window)
    assert all(
        calls.made[name]
        for name in ("mtf", "isoplanatism", "frame_statistics", "arrows", "count_colours", "quantity_maps")
    )
    assert not calls.made["mode_coefficients"]  # behind another tab


def test_panel_that_is_shown_again_shows_the_newest_measurement(window: MainWindow) -> None:
    docks = {dock.panel: dock for dock in window.docks.docks}
    for panel in (window.panels.camera, window.panels.wavefronts):
        docks[panel].hide()
    pixels, shown = dim_frame(), views(7)
    window.show_measurement(make_measurement(pixels, shown))
    for panel in (window.panels.camera, window.panels.wavefronts):
        docks[panel].show()
    assert window.panels.camera._image.counts is pixels
    maps = window.panels.wavefronts.grid.maps
    assert maps is not None
    np.testing.assert_array_equal(maps.values, shown)


def test_same_data_is_computed_and_painted_once(
    window: MainWindow, paints: Paints, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = Calls(monkeypatch)
    calls.count(quality, "isoplanatism")
    calls.count(camera, "frame_statistics")
    for _ in range(3):
        window.refresh()
        settle(window)
    assert calls.made == Counter()
    assert paints.of == Counter()


def test_text_is_painted_when_it_changes(paints: Paints, qtbot: QtBot) -> None:
    shown = ElidedLabel(text="RMS 0.1 rad")
    qtbot.addWidget(shown)
    shown.show()
    QApplication.processEvents()
    before = paints.of[shown]
    shown.setText("RMS 0.1 rad")
    QApplication.processEvents()
    assert paints.of[shown] == before
    shown.setText("RMS 0.2 rad")
    QApplication.processEvents()
    assert paints.of[shown] == before + 1


def test_picture_has_no_more_pixels_than_the_screen(window: MainWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    looked_up: list[int] = []
    image = window.panels.camera._image
    colours = image.colours

    def look_up(counts: camera_image.Counts) -> Pixels:
        looked_up.append(counts.size)
        return colours(counts)

    monkeypatch.setattr(image, "colours", look_up)
    pixels = np.full((2000, 2600), 1000, np.uint16)
    window.show_measurement(make_measurement(pixels, views()))
    QApplication.processEvents()
    viewport = window.panels.camera._graphics.viewport()
    assert viewport is not None
    assert 0 < looked_up[-1] <= viewport.width() * viewport.height()
    window.panels.camera._view.setRange(xRange=(100, 110), yRange=(100, 110), padding=0)
    QApplication.processEvents()
    assert 0 < looked_up[-1] < 1000
