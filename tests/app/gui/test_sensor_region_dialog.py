"""Sensor region and binning, chosen in the window."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PyQt6.QtCore import Qt
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import MakeWindow, press, wait_for_wavefront

from app.gui.shell.main_window import MainWindow
from drivers.interface import CameraCapabilities, Frame, Region

SENSOR = Region(0, 0, 300, 430)


class PartCamera(FakeCamera):
    """Reads out a part of its sensor, in steps of 10 pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.part = SENSOR

    def _read_capabilities(self) -> CameraCapabilities:
        allowed = super()._read_capabilities()
        return replace(
            allowed, rows=self.part.rows, columns=self.part.columns, sensor=SENSOR, region_step_px=10, binnings=(1, 2)
        )

    def _read_region(self) -> Region:
        return self.part

    def _set_region(self, region: Region) -> Region:
        self.part = region
        return region

    def _read(self, timeout_s: float) -> Frame:
        frame, part = super()._read(timeout_s), self.part
        pixels = frame.pixels[part.top : part.top + part.rows, part.left : part.left + part.columns]
        return replace(frame, pixels=pixels.copy())


@pytest.fixture
def window(make_window: MakeWindow, qtbot: QtBot) -> MainWindow:
    window = make_window(PartCamera())
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    return window


def fill_in(window: MainWindow, region: Region) -> None:
    dialog = window.region_dialog
    values = region.top, region.left, region.rows, region.columns
    for field, value in zip(dialog._sides, values, strict=True):
        field.setValue(value)


def text(window: MainWindow) -> str:
    window.update_text()
    return window.messages.text.text()


@pytest.mark.slow
@pytest.mark.long
def test_region_is_applied_and_calibrated_again(
    window: MainWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.gui.shell.messages._NOTICE_S", 1e9)  # it does not expire
    press(qtbot, window, Qt.Key.Key_P)
    dialog = window.region_dialog
    assert dialog.isVisible()
    assert dialog.area.region == SENSOR
    assert "300 x 430 pixels, in steps of 10 px" in dialog.limits.text()
    # Cells lie at 215 - 6.5 * 31.25 = 11.9 ... 418.1 and 150.5 - 4.5 * 31.25 = 9.9 ... 291.1: the last three rows of
    # lenslets, from 197.4 on, and the first column are cut.
    fill_in(window, Region(3, 41, 211, 386))
    dialog.apply.click()
    qtbot.waitUntil(lambda: window._status is not None and window._status.area.region != SENSOR)
    qtbot.waitUntil(lambda: not dialog.isVisible())
    qtbot.waitUntil(lambda: "lenslets are cut off" in text(window))
    assert text(window).startswith(f"{117 - 6 * 12} of 117 lenslets")
    assert "(D)" in text(window)
    assert "(R)" in text(window)
    press(qtbot, window, Qt.Key.Key_P)
    assert "220 x 390" in dialog.in_force.text()
    assert dialog.area.region == Region(0, 40, 220, 390)  # as rounded by the camera
    dialog.close()
    window.messages.clear_notice()
    assert text(window).endswith("take it again  (D: dark, R: reference)")
    window.controls.dark.click()
    window.controls.reference.click()
    qtbot.waitUntil(lambda: window.verdict.valid == "72 of 72")
    qtbot.waitUntil(lambda: window._status is not None and window._status.warning == "")


@pytest.mark.slow
@pytest.mark.long
def test_region_without_most_lenslets_is_to_be_enlarged(window: MainWindow, qtbot: QtBot) -> None:
    press(qtbot, window, Qt.Key.Key_P)
    dialog = window.region_dialog
    fill_in(window, Region(0, 0, 120, 130))  # three rows and three columns, from 9.9 and 11.9 px on
    dialog.apply.click()
    qtbot.waitUntil(lambda: window._status is not None and window._status.area.region != SENSOR)
    qtbot.waitUntil(lambda: not dialog.isVisible())
    advice = "108 of 117 lenslets are outside the region of 120 x 130 pixels from row 0, column 0: enlarge it (P)"
    qtbot.waitUntil(lambda: text(window) == advice)
    window.messages.clear_notice()
    assert text(window) == advice  # and no advice to take a reference, which could not be used
    window.controls.reference.click()
    qtbot.waitUntil(lambda: window.controller.is_settled)
    window.messages.clear_notice()
    qtbot.waitUntil(lambda: text(window) == advice)


@pytest.mark.slow
@pytest.mark.long
def test_buttons_fill_in_lattice_and_whole_sensor(window: MainWindow, qtbot: QtBot) -> None:
    window.controls.sensor_region.click()
    dialog = window.region_dialog
    dialog.around.click()
    assert dialog.area.region == SENSOR  # the margin reaches beyond the sensor
    fill_in(window, Region(10, 20, 100, 110))
    assert dialog.area.region == Region(10, 20, 100, 110)
    window.controls.light.click()  # other changes keep the filled-in values
    qtbot.waitUntil(lambda: window._status is not None and not window._status.is_light_on)
    assert dialog.area.region == Region(10, 20, 100, 110)
    dialog.whole.click()
    assert dialog.area.region == SENSOR


@pytest.mark.slow
@pytest.mark.long
def test_region_is_refused_while_recording(window: MainWindow, qtbot: QtBot, tmp_path: Path) -> None:
    window.recording_bar.recordings_folder = tmp_path
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: window.recording_panel.record.text() == "Stop REC")
    window.controls.sensor_region.click()
    fill_in(window, Region(0, 0, 100, 100))
    window.region_dialog.apply.click()
    qtbot.waitUntil(lambda: "The region cannot change during a recording" in text(window))
    assert window._status is not None
    assert window._status.area.region == SENSOR


@pytest.mark.slow
def test_camera_without_regions_shows_a_message(live: tuple[MainWindow, FakeCamera]) -> None:
    window, _ = live
    window.controls.sensor_region.click()
    assert not window.region_dialog.isVisible()
    assert text(window) == "Fake camera always reads out its whole sensor and cannot bin"
