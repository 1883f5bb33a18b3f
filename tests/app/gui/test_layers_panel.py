"""Panel of the layers, on a simulated frame whose layer is known."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from pytestqt.qtbot import QtBot
from support.gui_bench import make_frame
from support.patience import wait_until
from support.window_tools import MakeWindow, click, tab

from app.bench.config import load_bench
from app.evaluation.frames import simulate
from app.gui.panels.layers import LayersPanel
from app.gui.shell.main_window import MainWindow
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.measurement import FrameTotals, Measurement
from app.results.layers import Origin, find_shown_layers
from simulated_devices.sample import make_sample

DISTANCE_M = 0.195  # of the screen in small_demo


def measured(*settings: str) -> Measurement:
    bench = load_bench("small_demo", settings)
    images = simulate(bench)
    dark, reference = (
        Average(image, np.zeros_like(image), 1, 0.02, 8.0, "em") for image in (images.dark, images.reference)
    )
    calibration = Calibration.of(bench, reference, dark=dark, full_scale=65535.0)
    frame = images.frames[0].astype(np.uint16)
    wavefront = calibration.reconstructor()(frame)
    counts, now_s = FrameTotals(1, 1, 0), time.perf_counter()
    return Measurement(make_frame(frame), wavefront, "", counts, now_s, 0.004, calibration=calibration)


@pytest.fixture(scope="module")
def measurement() -> Measurement:
    return measured()


@pytest.fixture
def window(make_window: MakeWindow, measurement: Measurement) -> MainWindow:
    made = make_window()
    made.show_measurement(measurement)
    return made


def found_at_mm(panel: LayersPanel) -> float:
    """Return the distance at which the plot marks the found layer."""
    marks_mm, _ = panel.plot.marks.getData()
    assert np.ptp(marks_mm) == 0
    return float(marks_mm[0])


def open_tab(qtbot: QtBot, window: MainWindow, title: str) -> None:
    click(qtbot, *tab(window, title))


def test_pointer_reads_x_and_y_on_the_layer(make_window: MakeWindow) -> None:
    panel = make_window().panels.layers
    found = xr.Dataset(
        {
            "layer_phase": (("layer", "y", "x"), np.full((1, 21, 31), 0.5)),
            "phase_limit": ("layer", [1.0]),
            "distance_m": ("layer", [0.1]),
            "distance_sigma_m": ("layer", [np.nan]),
            "model_misfit": ("model", [0.02, 0.01]),
            "misfit": ("distance", [0.5, 0.02, 0.5]),
        },
        {
            "distance": [0.05, 0.1, 0.15],
            "x": np.linspace(-3e-3, 3e-3, 31),
            "y": np.linspace(-2e-3, 2e-3, 21),
            "model": ["one layer", "any wavefront"],
        },
        {"distances_from": "lenslets", "verdict": "one layer", "doubt": ""},
    )
    panel.show_result(found)
    corner = panel.map.places.tile(0, 0).topRight()
    assert panel.map._value_at(corner).startswith("+3.00, -2.00 mm on the layer: ")


@pytest.mark.slow
@pytest.mark.long
def test_layer_is_found_with_curve_and_map(window: MainWindow, qtbot: QtBot) -> None:
    open_tab(qtbot, window, "Layers")
    panel = window.panels.layers
    qtbot.waitUntil(lambda: panel.map.maps is not None)
    assert panel.sentence.text().startswith("One layer 19")
    assert " mm in front of the lenslets: " in panel.sentence.text()
    found_mm = found_at_mm(panel)
    assert found_mm == pytest.approx(DISTANCE_M * 1e3, abs=4)
    distance_mm, percent = panel.plot.curve.getData()
    assert abs(distance_mm[np.argmin(percent)] - DISTANCE_M * 1e3) < 20
    assert percent[distance_mm == 0] > 5 * percent.min()
    assert percent[np.argmin(np.abs(distance_mm + DISTANCE_M * 1e3))] > 10 * percent.min()  # as far behind the lenslets
    low_mm, high_mm = panel.plot.view.viewRange()[0]
    assert (low_mm, high_mm) == pytest.approx((-found_mm, 2 * found_mm), rel=1e-3)
    maps = panel.map.maps
    assert maps is not None
    bench = load_bench("small_demo")
    x_m, y_m = (np.linspace(-half_mm, half_mm, 65) * 1e-3 for half_mm in maps.reach)
    true = make_sample(bench.simulation, bench.sensor, bench.field).screen.at(x_m, y_m[:, None])
    inner = slice(8, -8)
    assert np.std((maps.values[0, 0] - true)[inner, inner]) < 0.05 * np.std(true)
    assert "mm on the layer: " in panel.map._value_at(panel.map.places.tile(0, 0).center())
    window.panels.wavefronts.menu.units[2].trigger()  # nm
    panel.mode.setCurrentIndex(0)
    window.analyses.of[panel].request = None  # searched again at once
    qtbot.waitUntil(lambda: panel.map.maps is not None and panel.map.maps.scale.title == "nm")
    in_nm = panel.map.maps
    assert in_nm is not None
    np.testing.assert_allclose(in_nm.values, maps.values * 462 / (2 * np.pi), rtol=1e-6)


def test_distances_from_the_mask(window: MainWindow, qtbot: QtBot) -> None:
    open_tab(qtbot, window, "Layers")
    panel = window.panels.layers
    panel.origin.setCurrentIndex(1)
    qtbot.waitUntil(lambda: "from the mask" in panel.sentence.text())
    assert found_at_mm(panel) == pytest.approx(200 / (1 + 0.975), abs=1)  # of the screen: f1 / (1 + r), mm
    assert panel.plot.axes["bottom"].labelText == "distance from the mask (mm)"
    assert panel.plot.view.viewRange()[0] == pytest.approx([0, 200])


@pytest.mark.slow
@pytest.mark.long
def test_layer_behind_the_lenslets_is_measured_from_them(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    window.show_measurement(measured("simulation.screen.distance_m=-0.1"))
    open_tab(qtbot, window, "Layers")
    panel = window.panels.layers
    panel.origin.setCurrentIndex(1)  # from the mask
    qtbot.waitUntil(lambda: " mm behind the lenslets: " in panel.sentence.text())
    assert panel.origin.currentData() == "lenslets"
    assert found_at_mm(panel) == pytest.approx(-100, abs=10)
    panel.origin.setCurrentIndex(1)
    qtbot.waitUntil(lambda: panel.origin.currentData() == "lenslets")


def test_closed_panels_compute_nothing(window: MainWindow, qtbot: QtBot, measurement: Measurement) -> None:
    open_tab(qtbot, window, "Histogram")
    window.show_measurement(replace(measurement))
    window.analyses.poll()
    assert window.analyses.of[window.panels.layers].request is None


@pytest.mark.slow
def test_lost_wavefront_makes_the_map_grey(window: MainWindow, qtbot: QtBot, measurement: Measurement) -> None:
    open_tab(qtbot, window, "Layers")
    panel = window.panels.layers
    qtbot.waitUntil(lambda: panel.map.maps is not None and not panel.map.is_stale)
    window.show_measurement(replace(measurement, wavefront=None, problem="no light"))
    qtbot.waitUntil(lambda: panel.map.is_stale)
    panel.mode.setCurrentIndex(1)
    window.show_measurement(replace(measurement))
    qtbot.waitUntil(lambda: not panel.map.is_stale)


@pytest.mark.slow
def test_displacements_alike_over_the_field_show_no_layer(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    window.show_measurement(measured("registration.warp=translation"))
    open_tab(qtbot, window, "Layers")
    panel = window.panels.layers
    before = panel.map.empty  # the search has not ended
    qtbot.waitUntil(lambda: not panel.sentence.text().startswith("Searching"))
    assert panel.sentence.text() == "No layer: the distance of a layer needs displacements that change over the field"
    assert (before, panel.map.empty) == ("Searching\N{HORIZONTAL ELLIPSIS}", "no layer")


def test_closing_ends_a_search(window: MainWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = threading.Event()

    def find_until_closed(
        measurement: Measurement, origin: Origin, *, count: int, check: Callable[[], None]
    ) -> xr.Dataset | str:
        def check_when_closing() -> None:
            begun.set()
            wait_until(lambda: window.analyses.is_closing)
            check()

        return find_shown_layers(measurement, origin, count=count, check=check_when_closing)

    monkeypatch.setattr("app.gui.panels.layers.find_shown_layers", find_until_closed)
    panel = window.panels.layers
    analysis = window.analyses.of[panel]
    panel.mode.setCurrentIndex(1)
    open_tab(qtbot, window, "Layers")
    qtbot.waitUntil(begun.is_set)
    window.close()
    assert not any(one.is_alive() for one in analysis.thread._threads)
    assert panel.sentence.text() == "Searching\N{HORIZONTAL ELLIPSIS}"
