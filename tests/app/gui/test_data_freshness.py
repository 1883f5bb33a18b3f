"""Badges and grey of what is not live."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
from PyQt6.QtCore import Qt
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera, make_measurement
from support.window_tools import dim_frame, press, views

from app.acquisition.dark_reference_store import AverageState
from app.acquisition.instrument import Activity
from app.gui.panels.panel import DataFreshness
from app.gui.shell.main_window import MainWindow
from app.gui.shell.status_text import AlarmTracker, advice, data_freshness
from app.gui.widgets.enlarged_view import EnlargedView
from app.measurement.measurement import Assumptions
from app.recording.playback_devices import RecordedLight
from drivers.interface import Disconnected


def is_grey(window: MainWindow) -> bool:
    """True if no panel, nor the enlarged view, shows a result in colour; False if all do."""
    panels, enlarged = window.panels, window.findChild(EnlargedView)
    assert enlarged is not None
    states = {tile.is_stale for tile in (panels.wavefronts.grid, *panels.lenslet.tiles.values(), enlarged.map)}
    plots = panels.quality.mtf, panels.quality.structure, panels.coefficients.plot, enlarged.across
    states |= {plot.view.childGroup.opacity() < 1 for plot in plots}
    states |= {panels.camera._view.childGroup.opacity() < 1}
    texts = (
        panels.wavefronts._summary,
        panels.quality.sentence,
        panels.coefficients.plot.title,
        panels.coefficients.numbers,
    )
    states |= {bool(text.property("stale")) for text in texts}
    assert len(states) == 1
    return states.pop()


def badges(window: MainWindow) -> tuple[str, str, str]:
    camera, wavefront, lenslet = (
        window.panels.camera.badge,
        window.panels.wavefronts._summary,
        window.panels.lenslet.name,
    )
    stale = next((part for part in wavefront.text().split("; ") if ": " in part), "")
    return camera.text() if camera.isVisible() else "", stale, lenslet.text()


def test_live_frame_has_no_badge(live: tuple[MainWindow, FakeCamera]) -> None:
    window, _ = live
    status, newest = window.controller.status, window.shown.measurement
    assert status is not None
    assert newest is not None
    now = replace(newest, exposure_end_s=1e18)  # not older than any test takes
    assert data_freshness(status, "", Activity(), now) == DataFreshness()
    assert data_freshness(status, "", Activity("taking the dark", 0.5), now) == DataFreshness()
    old = replace(newest, exposure_end_s=newest.exposure_end_s - 200)
    preparing = data_freshness(status, "", Activity("preparing the reconstruction"), old)
    assert preparing == DataFreshness("BUSY, 3 min old", "preparing the reconstruction", is_grey=True)
    late = data_freshness(status, "", Activity(), old)
    assert late == DataFreshness("LATE, 3 min old", "no newer frame has come yet", is_grey=True)
    assert data_freshness(status, "", Activity(), replace(old, latency_s=150.0)) == DataFreshness()  # of a slow method
    renamed = replace(status, light_name=RecordedLight.name)  # a name makes no replay
    assert data_freshness(renamed, "", Activity(), now) == DataFreshness()
    assert data_freshness(replace(status, is_replay=True), "", Activity(), now).badge == "REPLAY"
    other = replace(now, assumed=Assumptions(None, is_other=True))
    for each in (status, replace(status, is_replay=True)):
        shown = data_freshness(each, "", Activity(), other)
        assert (shown.badge, shown.is_grey) == ("ANOTHER SAMPLE? SEARCHING", False)
    assert data_freshness(None, "", Activity(), None) == DataFreshness()
    assert data_freshness(
        None, "", Activity("opening the devices"), None
    ).is_grey  # a picture of another bench may be seen


def test_alarm_is_about_frames_of_the_present_conditions() -> None:
    """An alarm about an earlier frame ends when, for example, the exposure is changed."""
    names, good = ("bench", "mask", "is_sample_in", "exposure_s", "warning"), AverageState("20 frames")
    well: Any = SimpleNamespace(**dict.fromkeys(names, ""), dark=good, reference=good, is_light_on=True)
    well.is_running, well.is_replay = True, False
    situation, before_s = AlarmTracker(), time.perf_counter()
    assert not situation.alarm(well, Activity(), None)
    problem = replace(make_measurement(dim_frame(), views()), problem="too dark", wavefront=None)
    alarms = [
        situation.alarm(well, Activity(), replace(problem, exposure_end_s=end_s))
        for end_s in (before_s - 1, time.perf_counter())
    ]
    assert alarms == ["", "too dark"]


@pytest.mark.slow
def test_stopped_frame_keeps_its_colours_and_disconnected_one_is_grey(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    window.panels.wavefronts.enlarge()
    window.docks.float_panels(window.panels.quality, window.panels.coefficients, window.panels.lenslet)
    window.panels.lenslet.inspect(4, 6)
    qtbot.waitUntil(lambda: window.panels.lenslet.name.text() == "Lenslet row 4, column 6: converged")
    qtbot.waitUntil(lambda: bool(window.panels.quality.sentence.text()))
    assert not is_grey(window)
    press(qtbot, window, Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: badges(window)[0].startswith("PAUSED, 2 s"))  # older than a running camera's frames
    assert not is_grey(window)
    for text in badges(window):
        assert "PAUSED, " in text
    assert "Space starts it" in badges(window)[1]
    press(qtbot, window, Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: badges(window) == ("", "", "Lenslet row 4, column 6: converged"))
    camera.fault = Disconnected("the camera was unplugged")
    qtbot.waitUntil(lambda: badges(window)[0].startswith("DISCONNECTED, "))
    qtbot.waitUntil(lambda: is_grey(window))
    assert "unplugged" in badges(window)[1]
    assert "DISCONNECTED" in badges(window)[2]


@pytest.mark.slow
def test_frame_of_a_file_without_wavefront_gives_the_reason(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    """Also with the light off, which did not shine on it."""
    window, camera = live
    tifffile.imwrite(tmp_path / "dim.tif", np.full(camera._images[0].shape, 501, np.uint16))
    window.controls.light.click()
    qtbot.waitUntil(lambda: window.controls.light.text() == "Light off")
    window.open_file(tmp_path / "dim.tif")
    qtbot.waitUntil(lambda: badges(window)[0] == "FILE dim.tif")
    assert window.shown.measurement is not None
    reason = window.shown.measurement.problem
    assert reason
    qtbot.waitUntil(lambda: window.messages.text.text().lower() == reason.lower())


def test_late_frame_is_not_blamed_on_a_slow_method_or_a_command(live: tuple[MainWindow, FakeCamera]) -> None:
    window, _ = live
    status, newest = window.controller.status, window.shown.measurement
    assert status is not None
    assert newest is not None
    old = replace(newest, exposure_end_s=time.perf_counter() - 7.0, latency_s=0.02)
    assert advice(status, Activity(), old) == "no newer frame has come for 7 s"
    assert advice(status, Activity(), replace(old, latency_s=4.0)).endswith("7 s: the method needs 4 s for each")
    single = Activity("reconstructing the frame", may_cancel=False)  # of a file or a replay
    assert advice(status, single, old) == "reconstructing the frame"


@pytest.mark.slow
def test_frame_of_a_file_says_so(live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path) -> None:
    window, camera = live
    tifffile.imwrite(tmp_path / "flat.tif", np.rint(500 + 40000 * camera._images[0]).astype(np.uint16))
    window.open_file(tmp_path / "flat.tif")
    qtbot.waitUntil(lambda: badges(window)[:2] == ("FILE flat.tif", "FILE flat.tif: Space returns to the camera"))
    press(qtbot, window, Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: badges(window)[:2] == ("", ""))


@pytest.mark.usefixtures("no_rest")
@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("is_inspected", [True, False])
def test_lenslet_without_wavefront_gives_the_reason(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, is_inspected: bool
) -> None:
    window, _ = live
    panel = window.panels.lenslet
    if is_inspected:
        window.panels.lenslet.inspect(4, 6)
        qtbot.waitUntil(lambda: panel.name.text().endswith("converged"))
    window.controls.light.click()
    qtbot.waitUntil(lambda: window.shown.wavefront is None)
    if not is_inspected:
        window.panels.lenslet.inspect(4, 6)
    qtbot.waitUntil(lambda: panel.numbers.text() == "nothing to inspect: the light is off: switch it on (L)")
    assert panel.name.text() == "Lenslet row 4, column 6: not measured"
    assert all(tile.is_stale for tile in panel.tiles.values())
    window.controls.light.click()
    qtbot.waitUntil(lambda: panel.name.text() == "Lenslet row 4, column 6: converged")
    assert not any(tile.is_stale for tile in panel.tiles.values())
