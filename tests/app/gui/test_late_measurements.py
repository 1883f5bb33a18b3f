"""Tests of the redraws that give way to late measurements."""

from __future__ import annotations

from dataclasses import replace

from pytestqt.qtbot import QtBot
from support.gui_bench import make_measurement
from support.window_tools import dim_frame, views

from app.gui.shell.base_window import BaseWindow


def test_one_redraw_of_three_is_left_out_while_results_are_late(qtbot: QtBot) -> None:
    first = make_measurement(dim_frame(), views())
    window = BaseWindow()
    qtbot.addWidget(window)

    def drawn(latency_s: float, between_s: float) -> list[bool]:
        """True for each of the next measurements that is drawn; `between_s` is the time from frame to frame."""
        found = []
        for frames in range(1, 10):
            frame = replace(first.frame, exposure_s=0.001, host_time_s=first.frame.host_time_s + frames * between_s)
            counts = replace(first.counts, acquired=first.counts.acquired + frames)
            newest = replace(first, frame=frame, counts=counts, latency_s=latency_s)
            found.append(not window.leaves_out(newest, first))
        return found

    assert drawn(0.013, 0.014) == 9 * [True]
    assert drawn(0.042, 0.014) == 3 * [False, True, True]
    assert drawn(0.042, 0.040) == 9 * [True]  # a short exposure, and time enough until the next


def test_nothing_is_late_beside_an_earlier_acquisition(qtbot: QtBot) -> None:
    """The camera counts from 0 again, or nothing was shown yet."""
    first = make_measurement(dim_frame(), views())
    again = replace(first, latency_s=10.0)
    window = BaseWindow()
    qtbot.addWidget(window)
    assert not any(window.leaves_out(again, shown) for shown in (None, first, None, first, None, first))
