"""Tests of the redraws that give way to late measurements."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera, make_measurement
from support.window_tools import dim_frame, views

from app.gui.shell.base_window import LateMeasurements
from app.gui.shell.main_window import MainWindow


def test_one_redraw_of_three_is_left_out_while_results_are_late() -> None:
    first = make_measurement(dim_frame(), views())
    late = LateMeasurements()

    def drawn(latency_s: float, between_s: float) -> list[bool]:
        """True for each of the next measurements that is drawn; `between_s` is the time from frame to frame."""
        found = []
        for frames in range(1, 10):
            frame = replace(first.frame, exposure_s=0.001, host_time_s=first.frame.host_time_s + frames * between_s)
            counts = replace(first.counts, acquired=first.counts.acquired + frames)
            newest = replace(first, frame=frame, counts=counts, latency_s=latency_s)
            found.append(not late.leave_out(newest, first))
        return found

    assert drawn(0.013, 0.014) == 9 * [True]
    assert drawn(0.042, 0.014) == 3 * [False, True, True]
    assert drawn(0.042, 0.040) == 9 * [True]  # a short exposure, and time enough until the next


def test_nothing_is_late_beside_an_earlier_acquisition() -> None:
    """The camera counts from 0 again, or nothing was shown yet."""
    first = make_measurement(dim_frame(), views())
    again = replace(first, latency_s=10.0)
    late = LateMeasurements()
    assert not any(late.leave_out(again, shown) for shown in (None, first, None, first, None, first))


@pytest.mark.slow
def test_window_leaves_such_redraws_out(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    left_out = []

    def leave_out(newest: object, _: object) -> bool:
        left_out.append(newest)
        return True

    with monkeypatch.context() as patch:
        patch.setattr(window._late, "leave_out", leave_out)
        shown = window.status_line.shown
        qtbot.waitUntil(lambda: len(left_out) >= 5)
        assert window.status_line.shown == shown
    qtbot.waitUntil(lambda: window.status_line.shown > shown)
