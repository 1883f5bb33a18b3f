"""Errors of the display, and what a new bench finds of the old one."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FakeCamera, opener
from support.optics import sensor_of

from app.acquisition.worker import Acquisition
from app.gui.shell.main_window import MainWindow
from app.results.history import RMS
from app.results.player import InstrumentFactory


@pytest.mark.slow
@pytest.mark.long
def test_inspected_lenslet_is_forgotten_with_its_bench(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    panel, lenslet = window.panels.camera, window.panels.lenslet
    panel.inspect((8, 12))
    assert lenslet.lenslet == (8, 12)
    smaller = replace(BENCH, sensor=sensor_of(5, 7))
    window.open(InstrumentFactory(lambda: Acquisition(smaller, opener(FakeCamera()))))
    assert lenslet.lenslet is None
    assert window.shown.wavefront is None
    assert not panel._inspected_box.isVisible()
    qtbot.waitUntil(lambda: window.verdict.valid == "35 of 35")
    assert "display failed" not in window.messages.log


@pytest.mark.slow
@pytest.mark.long
def test_error_in_a_refresh_is_shown_once(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    calls: list[object] = []

    def fail(*arguments: object) -> None:
        calls.append(arguments)
        raise IndexError("index 8 is out of bounds")

    with qtbot.capture_exceptions() as printed, window.reported_errors(), monkeypatch.context() as patch:
        patch.setattr(window.panels.camera, "show_measurement", fail)
        said = "The display failed (IndexError: index 8 is out of bounds; test_window_errors.py:"
        qtbot.waitUntil(lambda: len(calls) > 3 and said in window.messages.text.text())
    assert window.messages.log.count("display failed") == 1
    assert len(printed) == 1
    window.messages.escape()
    qtbot.waitUntil(lambda: window.verdict.valid == "117 of 117")
    assert window.messages.log.count("display failed") == 1


@pytest.mark.slow
def test_error_in_a_slot_is_shown_and_ends_nothing(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live

    def fail() -> None:
        raise IndexError("list index out of range")

    monkeypatch.setattr(window.controls, "show_switching_off", fail)
    with qtbot.capture_exceptions() as printed, window.reported_errors():
        for _ in range(2):
            window.controls.requested.emit("light", False)
        said = "The display failed (IndexError: list index out of range"
        qtbot.waitUntil(lambda: said in window.messages.text.text())
        window.messages.dismiss.click()
        qtbot.waitUntil(lambda: said not in window.messages.text.text())
        window.controls.requested.emit("light", False)
        qtbot.waitUntil(lambda: said in window.messages.text.text())  # again
    assert len(printed) == 2
    qtbot.waitUntil(lambda: not camera.light.shines)


@pytest.mark.slow
@pytest.mark.long
def test_history_and_pinned_coefficient_are_forgotten_with_their_bench(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, _ = live
    coefficients, history = window.panels.coefficients, window.panels.history
    coefficients.pin(4)
    qtbot.waitUntil(lambda: len(history.history.series(coefficients.name)[0]) > 1)
    name = coefficients.name
    window.open(InstrumentFactory(lambda: Acquisition(BENCH, opener(FakeCamera()))))
    assert coefficients.name == ""
    assert not len(history.history.series(RMS)[0])
    assert list(history.charts) == [RMS]
    qtbot.waitUntil(lambda: len(history.history.series(RMS)[0]) > 1)
    assert not len(history.history.series(name)[0])
