"""Limits of the history: one message for each crossing, the status line, the line in the chart, and what is kept."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PyQt6.QtCore import QSettings
from PyQt6.QtGui import QAction
from PyQt6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import MakeWindow, wait_for_wavefront

from app.gui.panels.history import HistoryPanel
from app.gui.panels.panel import DataFreshness
from app.gui.shell.main_window import MainWindow
from app.gui.widgets import theme
from app.results.history import RMS
from app.results.shown_wavefront import Unit


@pytest.fixture
def window(make_window: MakeWindow) -> MainWindow:
    window = make_window()
    window.panels.history.front_requested.emit()
    window.shown.wavelength_m = 462e-9
    return window


def set_limits(panel: HistoryPanel, series: str, lowest: str = "", highest: str = "") -> None:
    """Type both, and leave their lines."""
    for line, text in zip(panel.form.lines[series], (lowest, highest), strict=True):
        line.setText(text)
        line.editingFinished.emit()


def follow(window: MainWindow, series: str, *samples: tuple[float, float]) -> list[str]:
    """Add samples, time in s and value; return the messages that they cause."""
    told: list[str] = []
    panel = window.panels.history
    for signal in (panel.warned, panel.informed):
        signal.connect(told.append)
    for time_s, value in samples:
        panel.add(time_s, {series: value})
        window.update_text()
    for signal in (panel.warned, panel.informed):
        signal.disconnect(told.append)
    return told


def test_crossing_is_told_once_and_noise_at_the_limit_is_one_crossing(
    window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    beeps: list[int] = []
    monkeypatch.setattr(QApplication, "beep", lambda: beeps.append(1))
    panel = window.panels.history
    assert "RMS" not in window.verdict.toolTip()
    set_limits(panel, RMS, highest="1")
    assert follow(window, RMS, (0.0, 0.5)) == []
    assert "RMS 0.500 rad is within its limits" in window.verdict.toolTip()
    noisy = [(0.2 + index / 5, 1.2 - 0.4 * (index % 2)) for index in range(20)]
    assert follow(window, RMS, *noisy) == ["RMS 1.20 rad is above its limit of 1.00 rad"]
    assert window.verdict.text().startswith("BEYOND LIMITS")
    assert window.verdict.property("tone") == theme.tone(theme.RED)
    assert "above its limit" in window.messages.text.text()
    assert follow(window, RMS, (5.0, 0.9), (5.7, 0.9)) == []  # last beyond at 3.8 s
    assert follow(window, RMS, (5.9, 0.9)) == ["within the limits again: RMS"]
    assert not window.verdict.text().startswith("BEYOND LIMITS")
    assert follow(window, RMS, (6.1, 1.1)) == ["RMS 1.10 rad is above its limit of 1.00 rad"]
    assert not beeps
    panel.form.beep.click()
    follow(window, RMS, (9.0, 0.9), (9.2, 1.3), (9.4, 1.4))
    assert len(beeps) == 1


def test_frame_that_is_not_live_neither_passes_nor_alarms(window: MainWindow) -> None:
    panel = window.panels.history
    set_limits(panel, RMS, highest="1")
    window.shown.data_freshness = DataFreshness("PAUSED, 9 s old", "stopped", is_grey=True)
    panel.add(0.0, {RMS: 5.0})
    panel.show_numbers()
    assert window.shown.verdict.text == "\N{EN DASH}"
    panel.add(0.2, {})
    window.shown.data_freshness = DataFreshness()
    panel.show_numbers()
    assert window.shown.verdict == ("\N{EN DASH}", "RMS is unknown")  # unknown is not "pass"
    panel.forget_bench()
    panel.show_numbers()
    assert window.shown.verdict.text == "\N{EN DASH}"  # of the next bench nothing is known


def test_limit_of_a_phase_keeps_its_unit(window: MainWindow) -> None:
    panel = window.panels.history
    window.shown.unit = Unit.NM
    set_limits(panel, RMS, "0.1 rad", "46.2")
    assert panel.form.lines[RMS][1].text() == "46.2 nm"
    limits = panel.form.limits()[RMS]
    assert (limits.lowest, limits.highest) == pytest.approx((0.1, 0.1 * 2 * np.pi), rel=1e-9)  # 462 nm are 2 pi
    window.shown.unit = Unit.WAVES
    assert follow(window, RMS, (0.0, 0.2 * np.pi), (0.2, 0.21 * np.pi)) == [
        "RMS 0.105 waves is above its limit of 0.100 waves"
    ]


@pytest.mark.parametrize("text", ["much", "5 mrad", "5 ms", "1e999", "nan"])
def test_what_is_no_limit_is_red(window: MainWindow, text: str) -> None:
    set_limits(window.panels.history, RMS, highest=text)
    line = window.panels.history.form.lines[RMS][1]
    assert theme.RED.name() in line.styleSheet()
    assert "no number" in line.toolTip()
    assert window.panels.history.form.limits() == {}
    set_limits(window.panels.history, RMS, "2", "1")
    assert "No value can be within" in line.toolTip()
    assert window.panels.history.form.limits() == {}
    set_limits(window.panels.history, RMS)
    assert not line.styleSheet()


@pytest.mark.parametrize(("lowest", "highest"), [("", "0.5x"), ("3", "2")])
def test_former_limits_hold_while_texts_are_refused(window: MainWindow, lowest: str, highest: str) -> None:
    panel = window.panels.history
    set_limits(panel, RMS, highest="1")
    set_limits(panel, RMS, lowest, highest)
    line = panel.form.lines[RMS][1]
    assert theme.RED.name() in line.styleSheet()
    assert line.toolTip().endswith(": the former limits hold")
    window.shown.unit = Unit.NM
    assert panel.form.limits()[RMS].highest == 1
    assert follow(window, RMS, (0.0, 5.0)) != []
    assert window.shown.verdict.text == "fail"
    set_limits(panel, RMS)
    assert panel.form.limits() == {}


def test_limits_are_kept_between_two_starts(make_window: MakeWindow, tmp_path: Path) -> None:
    settings = QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat)
    first = make_window(saved=settings)
    next(one for one in first.findChildren(QAction) if one.text() == "Limits of the history…").trigger()
    assert first.panels.history.form.isVisible()
    first.shown.unit, first.shown.wavelength_m = Unit.NM, 462e-9
    set_limits(first.panels.history, RMS, "5", "50")
    first.panels.history.form.beep.click()
    first.close()
    form = make_window(saved=settings).panels.history.form
    assert [line.text() for line in form.lines[RMS]] == ["5 nm", "50 nm"]
    assert form.beep.isChecked()


def test_pinned_coefficient_has_limits_until_another_is_pinned(window: MainWindow) -> None:
    panel = window.panels.history
    assert not panel.form.lines[""][0].isEnabled()
    panel.pin("Z4 defocus")
    set_limits(panel, "", "-0.1", "0.1")
    assert follow(window, "Z4 defocus", (0.0, -0.2)) == [
        "Z4 defocus \N{MINUS SIGN}0.200 rad is below its limit of \N{MINUS SIGN}0.100 rad"
    ]
    panel.pin("Z5 astigmatism")
    assert panel.form.limits() == {}
    panel.pin("")
    assert not panel.form.lines[""][0].isEnabled()


def is_judged(window: MainWindow, verdict: str) -> bool:
    word = "BEYOND LIMITS" if verdict == "fail" else ""
    return window.shown.verdict.text == verdict and window.verdict.text().startswith(word)


@pytest.mark.slow
@pytest.mark.long
def test_live_wavefront_is_compared(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    wait_for_wavefront(qtbot, window)
    for highest, verdict in (("1e6 rad", "pass"), ("1e-6 rad", "fail")):
        set_limits(window.panels.history, RMS, highest=highest)
        qtbot.waitUntil(partial(is_judged, window, verdict))
    assert "is above its limit of" in window.messages.log
