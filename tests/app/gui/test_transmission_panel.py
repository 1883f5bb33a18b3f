"""Tab of the transmission: what the sample lets through at every view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pytestqt.qtbot import QtBot
from support.gui_bench import make_measurement
from support.wavefronts import modal
from support.window_tools import MakeWindow, click, dim_frame, tab, views

from app.gui.shell.main_window import MainWindow
from app.measurement.measurement import Measurement
from reconstruction.displacement import Transmission


def measurement(*, is_known: bool = True) -> Measurement:
    """A transmission of 0.8 that grows by 0.1 to the field's edge along x, more through the lenslets of row 2."""
    wavefront = modal(np.zeros((6, 3)))
    lenslets = wavefront.displacement.valid.shape
    coefficients, covariance = np.zeros((*lenslets, 6)), np.zeros((*lenslets, 6, 6))
    coefficients[..., 0], coefficients[..., 1], covariance[..., 0, 0] = 0.8, 0.1, 0.02**2
    coefficients[2, :, 0] = 0.95
    found = Transmission(coefficients, covariance) if is_known else None
    displacement = replace(wavefront.displacement, transmission_source=found)
    return replace(make_measurement(dim_frame(), views()), wavefront=replace(wavefront, displacement=displacement))


def shown(make_window: MakeWindow, qtbot: QtBot, measured: Measurement) -> MainWindow:
    window = make_window()
    window.show_measurement(measured)
    click(qtbot, *tab(window, "Transmission"))
    qtbot.waitUntil(lambda: bool(window.panels.transmission.sentence.text()))
    return window


def test_maps_are_the_transmission_at_the_views(make_window: MakeWindow, qtbot: QtBot) -> None:
    panel = shown(make_window, qtbot, measurement()).panels.transmission
    maps = panel.grid.maps
    assert maps is not None
    np.testing.assert_allclose(maps.values[:, :, 0, 0], [np.array([-5, 0, 5]) / 60 + 0.8] * 3, atol=1e-12)
    np.testing.assert_allclose(maps.values[1, 1, 2], 0.95)
    assert (maps.scale.low, maps.scale.high) == pytest.approx((0.7, 1.1))
    assert maps.describe(2, 1, 0.95) == "row 2, column 1: 0.950"
    assert "error 0.0200 by noise" in panel.sentence.text()


def test_method_without_transmission_is_named(make_window: MakeWindow, qtbot: QtBot) -> None:
    panel = shown(make_window, qtbot, measurement(is_known=False)).panels.transmission
    assert panel.grid.maps is None
    assert "does not measure the transmission" in panel.sentence.text()
