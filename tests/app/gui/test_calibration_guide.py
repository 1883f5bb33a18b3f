"""Guided calibration: all steps in order, questions to the person, cancelling and failures."""

from __future__ import annotations

import numpy as np
import pytest
from PyQt6.QtCore import Qt
from pytestqt.qtbot import QtBot
from support.gui_bench import FULL_SCALE, FakeCamera, make_frame, opener
from support.manual_bench import MANUAL
from support.window_tools import MakeWindow, press, wait_for_wavefront
from test_window_calibration import is_about, move_lattice

from app.acquisition.start_up import DARK, EXPOSURE, LATTICE, REFERENCE, STEPS, CalibrationStep
from app.acquisition.worker import Acquisition
from app.gui.shell.calibration import CalibrationGuide
from app.gui.shell.main_window import MainWindow
from app.results.player import InstrumentFactory
from drivers.interface import Frame


class ExposedCamera(FakeCamera):
    """Counts follow the exposure; `fill` of full scale at 20 ms."""

    fill = 0.35

    def _read(self, timeout_s: float) -> Frame:
        frame = super()._read(timeout_s)
        counts = 500 + (frame.pixels - 500.0) / 40000 * FULL_SCALE * self.fill * self._exposure / 0.02
        return make_frame(np.clip(counts, 0, FULL_SCALE).astype(np.uint16), index=frame.index)


@pytest.fixture
def camera() -> ExposedCamera:
    return ExposedCamera()


@pytest.fixture
def window(make_window: MakeWindow, qtbot: QtBot, camera: ExposedCamera) -> MainWindow:
    window = make_window(camera)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    window.controls.frames.setValue(5)
    return window


def state(guide: CalibrationGuide, step: CalibrationStep) -> str:
    return guide.lamps[step].toolTip()


@pytest.mark.slow
@pytest.mark.long
def test_button_takes_all_steps(window: MainWindow, qtbot: QtBot, camera: ExposedCamera) -> None:
    guide = window.guide
    window.controls.calibrate.click()
    assert guide.isVisible()
    assert state(guide, LATTICE) == "running"
    assert state(guide, REFERENCE) == "waiting"
    qtbot.waitUntil(lambda: guide.question.text() == "Calibrated.")
    assert {state(guide, step) for step in STEPS} == {"done"}
    assert "117 of 117 illuminated" in guide.results[LATTICE].text()
    assert "of full scale" in guide.results[EXPOSURE].text()
    status = window.controller.status
    assert status is not None
    level = 500 / FULL_SCALE + 0.35 * status.exposure_s / 0.02
    assert level == pytest.approx(0.7, abs=0.06)
    assert (status.dark.validity, status.reference.validity) == ("good", "good")
    assert status.dark.note.startswith("5 frames")
    assert f"{status.exposure_s * 1e3:.4g} ms" in status.reference.note
    assert camera.light.shines
    assert camera.is_running
    assert camera.stage.is_sample_in
    press(qtbot, guide, Qt.Key.Key_Escape)
    assert not guide.isVisible()


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("is_used", [True, False])
def test_another_lattice_is_used_only_when_accepted(window: MainWindow, qtbot: QtBot, is_used: bool) -> None:
    guide = window.guide
    move_lattice(window, qtbot, 211.0)
    window.controls.calibrate.click()
    qtbot.waitUntil(guide.yes.isVisible)
    assert guide.yes.text() == "Use this one"
    (guide.yes if is_used else guide.no).click()
    qtbot.waitUntil(lambda: guide.question.text() == "Calibrated.")
    qtbot.waitUntil(lambda: is_about(window, 215.0 if is_used else 211.0))


@pytest.mark.slow
@pytest.mark.long
def test_lattice_is_sought_again_after_the_exposure(
    window: MainWindow, qtbot: QtBot, camera: ExposedCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    guide = window.guide
    camera.fill = 1.2
    window.controls.exposure.setValue(90.0)  # clips the light
    qtbot.waitUntil(lambda: camera.exposure_s == 0.09)
    result = guide.results[LATTICE]
    said: list[str] = []  # a poll may come too late
    show = result.setText

    def say(text: str) -> None:
        said.append(text)
        show(text)

    monkeypatch.setattr(result, "setText", say)
    window.controls.calibrate.click()
    qtbot.waitUntil(lambda: guide.question.text() == "Calibrated.")
    assert state(guide, LATTICE) == "done"
    assert any("tried again after the exposure" in text for text in said[:-1])
    assert "117 of 117 illuminated" in said[-1]


@pytest.mark.slow
@pytest.mark.long
def test_esc_cancels_and_restores_the_devices(window: MainWindow, qtbot: QtBot, camera: ExposedCamera) -> None:
    guide = window.guide
    window.controls.frames.setValue(10_000)
    window.controls.calibrate.click()
    qtbot.waitUntil(lambda: state(guide, DARK) == "running" and not camera.light.shines)
    press(qtbot, guide, Qt.Key.Key_Escape)
    assert guide.isVisible()
    assert state(guide, DARK) == "failed"
    assert state(guide, REFERENCE) == "waiting"
    qtbot.waitUntil(lambda: window.controller.is_settled)
    assert camera.light.shines
    assert camera.is_running
    assert state(guide, REFERENCE) == "waiting"  # nothing follows


@pytest.mark.slow
def test_guide_ends_with_its_bench(window: MainWindow, camera: ExposedCamera) -> None:
    guide = window.guide
    window.controls.frames.setValue(10_000)
    window.controls.calibrate.click()
    assert state(guide, LATTICE) == "running"
    window.open(InstrumentFactory(lambda: Acquisition(MANUAL, opener(camera))))
    assert state(guide, LATTICE) == "failed"
    assert guide.question.text() == "Ended: the devices were connected again"
    assert not guide.end_for_light()


@pytest.mark.slow
@pytest.mark.long
def test_failed_step_can_be_repeated(window: MainWindow, qtbot: QtBot, camera: ExposedCamera) -> None:
    guide = window.guide
    camera.fill = 0.0
    window.controls.calibrate.click()
    qtbot.waitUntil(guide.yes.isVisible)
    assert guide.question.text() == "Exposure failed."
    assert state(guide, EXPOSURE) == "failed"
    camera.fill = 0.35
    guide.yes.click()
    qtbot.waitUntil(lambda: guide.question.text() == "Calibrated.")


@pytest.mark.slow
@pytest.mark.long
def test_person_is_asked_to_take_the_sample_out(make_window: MakeWindow, qtbot: QtBot, camera: ExposedCamera) -> None:
    window = make_window()
    window.open(InstrumentFactory(lambda: Acquisition(MANUAL, opener(camera))))
    qtbot.waitUntil(lambda: camera.is_running and window.controller.is_settled)
    window.controls.frames.setValue(5)
    guide = window.guide
    window.refresh()
    window.controls.calibrate.click()
    assert guide.question.text() == "Make sure that the sample is out of the beam"
    guide.no.click()
    assert guide.question.text() == "Stopped"
    window.controls.calibrate.click()
    guide.yes.click()
    qtbot.waitUntil(lambda: guide.question.text() == "Calibrated. Put the sample into the beam (S).")
