"""Limits of the history: one message for each crossing, the verdict, and the unit."""

from __future__ import annotations

import numpy as np
import pytest
from PyQt6.QtWidgets import QApplication, QInputDialog
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import MakeWindow, wait_for_wavefront

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


def set_limit(window: MainWindow, series: str, limit: float | None) -> str:
    """Answer the question for a limit, or refuse to; return the question."""
    asked: list[str] = []

    def answer(_parent: object, _title: str, text: str, before: float, *_: object) -> tuple[float, bool]:
        asked.append(text)
        return (before, False) if limit is None else (limit, True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(QInputDialog, "getDouble", answer)
        menu = window.panels.history.limits.menu()
        assert menu is not None
        menu.actions()[0 if series == RMS else 1].trigger()
    (question,) = asked
    return question


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
    set_limit(window, RMS, 1)
    assert follow(window, RMS, (0.0, 0.5)) == []
    assert "RMS 0.500 rad is within its limit" in window.verdict.toolTip()
    noisy = [(0.2 + index / 5, 1.2 - 0.4 * (index % 2)) for index in range(20)]
    assert follow(window, RMS, *noisy) == ["RMS 1.20 rad is beyond its limit of 1.00 rad"]
    assert window.verdict.text().startswith("BEYOND LIMITS")
    assert window.verdict.property("tone") == theme.tone(theme.RED)
    assert "beyond its limit" in window.messages.text.text()
    assert follow(window, RMS, (5.0, 0.9), (5.7, 0.9)) == []  # last beyond at 3.8 s
    assert follow(window, RMS, (5.9, 0.9)) == ["within the limits again: RMS"]
    assert not window.verdict.text().startswith("BEYOND LIMITS")
    assert follow(window, RMS, (6.1, 1.1)) == ["RMS 1.10 rad is beyond its limit of 1.00 rad"]
    assert not beeps
    panel.beep.trigger()
    follow(window, RMS, (9.0, 0.9), (9.2, 1.3), (9.4, 1.4))
    assert len(beeps) == 1


def test_frame_that_is_not_live_neither_passes_nor_alarms(window: MainWindow) -> None:
    panel = window.panels.history
    set_limit(window, RMS, 1)
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


def test_limit_is_asked_for_in_the_unit_of_the_display(window: MainWindow) -> None:
    window.shown.unit = Unit.NM
    assert set_limit(window, RMS, 46.2) == "Highest RMS allowed (nm); 0: no limit"  # 462 nm are 2 pi
    window.shown.unit = Unit.WAVES
    told = follow(window, RMS, (0.0, 0.19 * np.pi), (0.2, 0.21 * np.pi))
    assert told == ["RMS 0.105 waves is beyond its limit of 0.100 waves"]
    window.shown.unit, window.shown.wavelength_m = Unit.NM, float("nan")
    assert "(rad)" in set_limit(window, RMS, 1)  # before the first wavefront


def test_refused_question_keeps_the_limit_and_zero_removes_it(window: MainWindow) -> None:
    set_limit(window, RMS, 1)
    set_limit(window, RMS, None)
    assert follow(window, RMS, (0.0, 5.0)) == ["RMS 5.00 rad is beyond its limit of 1.00 rad"]
    set_limit(window, RMS, 0)
    assert follow(window, RMS, (9.0, 5.0)) == []
    assert not window.shown.verdict.text


def test_pinned_coefficient_has_a_limit_until_another_is_pinned(window: MainWindow) -> None:
    panel = window.panels.history
    assert not panel.limit_of_pinned.isEnabled()
    panel.pin("Z4 defocus")
    assert set_limit(window, "Z4 defocus", 0.1).startswith("Highest Z4 defocus allowed")
    assert follow(window, "Z4 defocus", (0.0, -0.2)) == [
        "Z4 defocus \N{MINUS SIGN}0.200 rad is beyond its limit of 0.100 rad"
    ]
    panel.pin("Z5 astigmatism")
    assert follow(window, "Z5 astigmatism", (0.2, -0.2)) == []
    panel.pin("")
    assert not panel.limit_of_pinned.isEnabled()


@pytest.mark.slow
@pytest.mark.long
def test_live_wavefront_is_compared(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    wait_for_wavefront(qtbot, window)
    for highest, verdict in ((1e6, "pass"), (1e-6, "fail")):
        set_limit(window, RMS, highest)
        qtbot.waitUntil(lambda verdict=verdict: window.shown.verdict.text == verdict)  # type: ignore[misc] # mypy and defaults
    assert "is beyond its limit of" in window.messages.log
