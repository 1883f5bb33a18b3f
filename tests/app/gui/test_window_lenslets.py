"""The window on a bench that omits rows and columns of lenslets, before and after the first reference."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pytestqt.qtbot import QtBot
from support import window_tools
from support.gui_bench import BENCH, FakeCamera
from support.window_tools import MakeWindow, wait_for_wavefront

OMITTED = replace(BENCH, sensor=replace(BENCH.sensor, lenslet_rows=None, lenslet_columns=None), lattice=None)


def test_window_shows_lenslets_that_the_reference_has(
    make_window: MakeWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(window_tools, "BENCH", OMITTED)
    window = make_window(FakeCamera(), frames=4)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    window.update_text()
    assert window.verdict.valid == "117 of 117"
    assert window._status is not None
    assert window._status.bench.sensor.lenslets == BENCH.sensor.lenslets
    assert window._status.bench_in_force.lattice is not None
