"""Calibration in the window: lattice proposal, automatic exposure, background check, saved bench."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import pytest
from PyQt6.QtCore import Qt
from PyQt6.QtWidgets import QFileDialog
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.patience import HANG_S
from support.window_tools import press, said_in

from app.bench.config import Bench, load_bench
from app.gui.shell.main_window import MainWindow


def bench_of(window: MainWindow) -> Bench:
    assert window._status is not None
    return window._status.bench


def move_lattice(window: MainWindow, qtbot: QtBot, center_x_px: float) -> None:
    """Displace the lattice of the bench."""
    lattice = bench_of(window).lattice
    assert lattice is not None
    change = "lattice", replace(lattice, center_x_px=center_x_px)
    assert window.controller.acquisition is not None
    window.controller.acquisition.change_settings([change]).result(HANG_S)
    qtbot.waitUntil(lambda: center_of(window) == center_x_px)


def center_of(window: MainWindow) -> float:
    lattice = bench_of(window).lattice
    assert lattice is not None
    return lattice.center_x_px


def is_about(window: MainWindow, center_x_px: float) -> bool:
    return abs(center_of(window) - center_x_px) < 0.1


@pytest.mark.slow
@pytest.mark.long
def test_lattice_is_used_only_when_accepted(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    move_lattice(window, qtbot, 211.0)
    for key, center_x_px in ((Qt.Key.Key_Escape, 211.0), (Qt.Key.Key_Return, 215.0)):  # the camera's is 215
        press(qtbot, window, Qt.Key.Key_N)
        qtbot.waitUntil(window.messages.accept.isVisible)
        assert "pitch 31.25" in window.messages.text.text()
        assert "117 of 117 illuminated" in window.messages.text.text()
        assert window.panels.camera._proposed_lines.isVisible()
        assert center_of(window) == 211.0
        press(qtbot, window, key)
        qtbot.waitUntil(lambda: not window.messages.accept.isVisible())
        assert not window.panels.camera._proposed_lines.isVisible()
        qtbot.waitUntil(lambda: window.controller.is_settled)
        qtbot.waitUntil(partial(is_about, window, center_x_px))


@pytest.mark.slow
def test_saved_bench_holds_settings_in_force(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    saved = tmp_path / "mine.toml"
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(saved), ""))
    window.controls.exposure.setValue(40.0)
    qtbot.waitUntil(lambda: window._status is not None and window._status.exposure_s == 0.04)
    window.benches.save()
    qtbot.waitUntil(lambda: f"Saved {saved}" in window.messages.log)
    bench = load_bench(saved)
    assert bench.lattice == bench_of(window).lattice
    wanted = {"exposure_s": 0.04, "amplifier": "em", "readout_speed": 3}
    assert asdict(bench.camera) == asdict(bench_of(window).camera) | wanted
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(saved / "b.toml"), ""))
    window.benches.save()
    qtbot.waitUntil(lambda: "the folder cannot be made" in said_in(window))


@pytest.mark.slow
def test_failed_auto_exposure_is_shown(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    press(qtbot, window, Qt.Key.Key_X)  # the fake camera's light does not depend on its exposure
    qtbot.waitUntil(lambda: window.controller.is_settled)
    window.update_text()
    assert window.messages._notice_colour.name() == "#f0b64a"
    assert camera.light.is_on
    assert camera.is_running


@pytest.mark.slow
def test_unchanged_background_is_confirmed(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    press(qtbot, window, Qt.Key.Key_B)
    qtbot.waitUntil(lambda: "dark is still good" in window.messages.text.text())
    assert camera.light.is_on


@pytest.mark.slow
def test_keys_do_not_answer_a_hidden_question(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    """Neither Return nor Esc may answer a question behind an alarm."""
    window, _ = live
    answers: list[bool] = []
    window.messages.answered.connect(answers.append)
    window.messages.ask("use it?")
    window.messages.alarm("the disk is full")
    press(qtbot, window, Qt.Key.Key_Return)
    press(qtbot, window, Qt.Key.Key_Escape)  # dismisses the alarm alone
    qtbot.waitUntil(window.messages.accept.isVisible)
    assert not answers
    press(qtbot, window, Qt.Key.Key_Escape)
    assert answers == [False]


@pytest.mark.slow
def test_alarm_stays_until_it_is_dismissed(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.messages.alarm("the disk is full")
    window.messages.inform("something nice")
    window.update_text()
    assert window.messages.text.text() == "The disk is full"
    press(qtbot, window, Qt.Key.Key_Escape)
    window.update_text()
    assert window.messages.text.text() == "Something nice"


@pytest.mark.slow
@pytest.mark.long
def test_dark_and_reference_are_confirmed(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.controls.frames.setValue(3)
    for key, name in ((Qt.Key.Key_D, "Dark"), (Qt.Key.Key_R, "Reference")):
        press(qtbot, window, key)
        qtbot.waitUntil(partial(says, window, f"{name} taken: mean of 3 frames; Ctrl+Z restores the one before"))


def says(window: MainWindow, text: str) -> bool:
    return window.messages.text.text() == text


@pytest.mark.slow
def test_highest_gain_is_shown_in_full(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.resize(900, 640)
    gain = window.controls.em_gain
    gain.setValue(1200)
    qtbot.waitUntil(lambda: gain.text() == "1200.0")
    line = gain.lineEdit()
    assert line is not None
    assert line.width() >= gain.fontMetrics().horizontalAdvance(gain.text())


def undo(window: MainWindow, qtbot: QtBot, *, restores: bool) -> str:
    """Press Ctrl+Z, answer the question and return it."""
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    qtbot.keyClick(window, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)  # type: ignore[no-untyped-call] # pytest-qt declares no types for it
    strip = window.messages
    qtbot.waitUntil(strip.accept.isVisible)
    question = strip.text.text()
    (strip.accept if restores else strip.discard).click()
    qtbot.waitUntil(strip.accept.isHidden)
    return question


@pytest.mark.slow
@pytest.mark.parametrize("key", [Qt.Key.Key_D, Qt.Key.Key_R])
def test_dark_and_reference_are_undone_in_one_step_that_says_how_they_were_taken(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, key: Qt.Key
) -> None:
    window, _ = live
    name = "dark" if key == Qt.Key.Key_D else "reference"
    window.activateWindow()

    def how() -> str:
        status = window.controller.status
        return "" if status is None else str(getattr(status, name).how)

    first = how()
    qtbot.wait(1100)  # their times have seconds
    press(qtbot, window, key)
    qtbot.waitUntil(lambda: how() != first and window.controller.is_settled)
    second = how()
    for before, restores, after in ((second, False, second), (second, True, first), (first, True, second)):
        assert how() == before
        returning = second if before == first else first
        question = undo(window, qtbot, restores=restores)
        assert question == f"Restore what was in force before the new {name} ({returning})?"
        qtbot.waitUntil(lambda after=after: how() == after and window.controller.is_settled)  # type: ignore[misc] # mypy and defaults
    assert f"before the new {name}; press Ctrl+Z to return" in window.messages.log


@pytest.mark.slow
def test_change_of_the_bench_is_undone(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.activateWindow()
    before = bench_of(window)
    window.shown.exclusion_requested.emit([(0, 0)], True)
    qtbot.waitUntil(lambda: bench_of(window) != before and window.controller.is_settled)
    assert "excluded" in undo(window, qtbot, restores=True)
    qtbot.waitUntil(lambda: bench_of(window) == before and window.controller.is_settled)
