"""The replay bar, by clicks and keys, on a recording of the small simulated bench."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PyQt6.QtCore import QEvent, QPoint, QRect, Qt
from PyQt6.QtGui import QHelpEvent
from PyQt6.QtWidgets import QApplication, QComboBox, QFileDialog, QToolTip, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.recordings import record
from support.records import frame_file
from support.served import served
from support.window_tools import click, part, picture, press

from app.acquisition.worker import Acquisition
from app.gui.shell.main_window import MainWindow
from app.gui.widgets import theme
from app.measurement.measurement import FrameTotals, Measurement
from app.recording.folder import describe
from app.recording.reader import Recording
from app.results.history import RMS
from app.results.player import InstrumentFactory, Player

FRAMES = 8


@pytest.fixture(scope="module")
def recording(quick_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(quick_toml, tmp_path_factory.mktemp("recording") / "run", frames=FRAMES)


@pytest.fixture
def played() -> list[Measurement]:
    """Every measurement of the replay, in order, also those that the window skips."""
    return []


@pytest.fixture
def window(qapp: QApplication, qtbot: QtBot, recording: Recording, played: list[Measurement]) -> Iterator[MainWindow]:
    """A window that plays frames 2 to 7 of the recording."""
    player = Player(recording.folder, frames="2:")

    def make() -> Acquisition:
        return Acquisition(player.bench, player.open_devices, sinks=(player.take, played.append))

    shown = MainWindow()
    shown.resize(1200, 800)
    shown.show()
    shown.open(InstrumentFactory(make, player.begin, player))
    qtbot.waitUntil(lambda: shown.verdict.valid == "35 of 35")
    yield shown
    shown.close()
    shown.deleteLater()
    qapp.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)


def counts(window: MainWindow) -> FrameTotals:
    assert window.controller.acquisition is not None
    assert window.controller.acquisition.newest is not None
    return window.controller.acquisition.newest.counts


def shown_frame(window: MainWindow, recording: Recording) -> int | None:
    """Index in the recording of the frame in the window."""
    assert window.controller.acquisition is not None
    newest = window.controller.acquisition.newest
    return None if newest is None else recorded_index(newest, recording)


def recorded_index(measurement: Measurement, recording: Recording) -> int | None:
    pixels = measurement.frame.pixels
    return next((index for index in range(FRAMES) if np.array_equal(pixels, recording.pixels(index))), None)


def pause(qtbot: QtBot, window: MainWindow) -> None:
    qtbot.waitUntil(lambda: window.replay.play.text() == "Pause")
    window.replay.play.click()
    qtbot.waitUntil(lambda: window.replay.play.text() == "Play")
    window.replay.refresh()  # or the slider, still at an earlier frame, might not move
    window.replay.slider.setValue(3)
    qtbot.waitUntil(lambda: window.replay.text.text() == "frame 5 of 7")
    qtbot.waitUntil(lambda: window.replay._wanted is None and window.replay._moving is None)


@pytest.mark.slow
@pytest.mark.long
def test_steps_show_the_frame_beside(window: MainWindow, qtbot: QtBot, recording: Recording) -> None:
    pause(qtbot, window)
    qtbot.waitUntil(lambda: shown_frame(window, recording) == 2 + 3)
    press(qtbot, window, Qt.Key.Key_Period)
    qtbot.waitUntil(lambda: shown_frame(window, recording) == 2 + 4)
    assert window.replay.text.text() == "frame 6 of 7"
    window.replay.back.click()
    window.replay.back.click()
    qtbot.waitUntil(lambda: shown_frame(window, recording) == 2 + 2)
    qtbot.waitUntil(lambda: window.replay.slider.value() == 2)
    assert window.replay.play.text() == "Play"
    qtbot.waitUntil(lambda: window.messages.text.text() == "The replay is paused: Space plays it")


def test_replay_continues_behind_the_chosen_frame(
    window: MainWindow, qtbot: QtBot, recording: Recording, played: list[Measurement]
) -> None:
    pause(qtbot, window)
    qtbot.waitUntil(lambda: shown_frame(window, recording) == 2 + 3)
    played.clear()
    press(qtbot, window, Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: len(played) > 2)
    assert [recorded_index(measurement, recording) for measurement in played[:3]] == [2 + 4, 2 + 5, 2]
    qtbot.waitUntil(lambda: window.replay.play.text() == "Pause")


def test_wavefront_of_a_chosen_frame_is_the_recorded_one(
    window: MainWindow, qtbot: QtBot, recording: Recording
) -> None:
    """Up to the starting point of the registration."""
    pause(qtbot, window)
    qtbot.waitUntil(lambda: shown_frame(window, recording) == 2 + 3)
    newest = window.controller.acquisition.newest if window.controller.acquisition else None
    assert newest is not None
    assert newest.registered is not None
    expected = recording.displacement(2 + 3)
    assert expected is not None
    np.testing.assert_allclose(newest.registered.coefficients, expected, atol=2e-3)


@pytest.mark.slow
@pytest.mark.long
def test_other_method_is_tried_in_the_settings(window: MainWindow, qtbot: QtBot) -> None:
    window.benches.edit()
    dialog = window.benches.settings_dialog
    _, editor = dialog.editors["reconstruction.method"]
    assert isinstance(editor, QComboBox)
    editor.setCurrentIndex(editor.findData("zonal"))
    editor.activated.emit(editor.currentIndex())
    dialog.apply.click()

    def is_zonal() -> bool:
        status = window.controller.status
        return status is not None and status.is_replay and status.bench.reconstruction.method == "zonal"

    qtbot.waitUntil(is_zonal)


def test_devices_are_disabled_and_reconstruction_is_not(window: MainWindow, qtbot: QtBot) -> None:
    pause(qtbot, window)
    controls = window.controls
    devices: tuple[QWidget, ...] = (
        controls.light,
        controls.sample,
        controls.dark,
        controls.reference,
        controls.exposure,
        controls.auto_exposure,
        controls.current,
        controls.sensor_region,
        window.recording_panel.record,
    )
    assert [widget.isEnabled() for widget in devices] == [False] * len(devices)
    assert controls.refine.isEnabled()
    assert controls.choices["readout_speed"].currentText() == "3"  # as recorded
    assert window.replay.badge.isVisible()
    assert not controls.start.isVisible()  # the bar has its own
    assert controls.light.text() == "Light was on"
    assert not controls.light.isChecked()  # no red edge
    before = counts(window)
    press(qtbot, window, Qt.Key.Key_L)  # the light
    press(qtbot, window, Qt.Key.Key_Period)
    qtbot.waitUntil(lambda: window.replay.text.text() == "frame 6 of 7")
    assert window.controller.status is not None
    assert window.controller.status.is_light_on
    qtbot.waitUntil(lambda: counts(window) != before)
    assert counts(window) == FrameTotals(before.acquired + 1, before.reconstructed + 1, before.lost)


@pytest.mark.slow
def test_recorded_losses_are_not_red(window: MainWindow, qtbot: QtBot) -> None:
    qtbot.waitUntil(lambda: window._status is not None and window.shown.measurement is not None)
    assert window.shown.measurement is not None
    for lost in (0, 50):
        counted = replace(window.shown.measurement.counts, lost=lost)
        window.status_line.count(replace(window.shown.measurement, counts=counted))
    window.status_line.update_text(window._status)
    assert window.status_line.lost.text() == "50"
    assert window.status_line.lost.property("tone") == theme.tone(theme.TEXT)
    assert "recorded" in window.status_line.lost.toolTip()


def test_speed_multiplies_the_recorded_rate(window: MainWindow, qtbot: QtBot, recording: Recording) -> None:
    qtbot.waitUntil(lambda: window.replay.play.text() == "Pause")
    window.replay.speed.setCurrentIndex(0)
    window.replay.speed.activated.emit(0)
    times_s: list[float] = []
    window.measurement_shown.connect(lambda measurement: times_s.append(measurement.frame.camera_time_s))
    qtbot.waitUntil(lambda: len(times_s) >= 7)
    recorded_s = np.diff([recording.line(index).host_time_s for index in range(2, FRAMES)])
    shortest_s = min(recorded_s.min(), recording.line(0).exposure_s)  # at the repeat the exposure takes its place
    assert np.diff(times_s[2:]).min() >= 0.999 * 4 * shortest_s  # two may have been scheduled before


def test_frame_is_looked_up_while_the_worker_plays_the_next(recording: Recording) -> None:
    player = Player(recording.folder)
    player._recent.extend([(1.0, 1), (2.0, 2)])

    class Time(float):
        """A time during whose comparison another frame is played."""

        __hash__ = float.__hash__

        def __eq__(self, other: object) -> bool:
            player._recent.append((3.0, 3))
            return float(self) == other

    frame: Any = SimpleNamespace(camera_time_s=Time(1.0))
    assert player.position_of(frame) == 1


@pytest.fixture
def own_recording(recording: Recording, tmp_path: Path) -> Recording:
    shutil.copytree(recording.folder, tmp_path / "20261122-130100")
    return Recording(tmp_path / "20261122-130100")


@pytest.mark.slow
@pytest.mark.long
def test_renamed_recording_is_played_on(window: MainWindow, qtbot: QtBot, own_recording: Recording) -> None:
    player = Player(own_recording.folder)
    window.open(InstrumentFactory(player.acquisition, player.begin, player))
    qtbot.waitUntil(lambda: "recording 20261122-130100" in window.windowTitle())
    qtbot.waitUntil(lambda: window.verdict.valid == "35 of 35")
    named = describe(own_recording.folder, name="mouse 7", note="")
    before = window.status_line.shown
    qtbot.waitUntil(lambda: window.status_line.shown > before + 2 * FRAMES)
    assert not window.controller.failure
    window.replay.slider.setValue(3)
    qtbot.waitUntil(lambda: shown_frame(window, Recording(named)) == 3)
    qtbot.waitUntil(lambda: "recording 20261122-130100-mouse 7" in window.windowTitle())


@pytest.mark.slow
@pytest.mark.long
def test_lost_recording_is_not_blamed_on_devices(window: MainWindow, qtbot: QtBot, own_recording: Recording) -> None:
    player = Player(own_recording.folder)
    window.open(InstrumentFactory(player.acquisition, player.begin, player))
    qtbot.waitUntil(lambda: "recording 20261122-130100" in window.windowTitle())
    shutil.rmtree(own_recording.folder)
    end = "the replay has ended: open the recording again (Ctrl+Shift+O)"
    qtbot.waitUntil(lambda: window.messages.text.text().endswith(end))
    assert "cannot be read" in window.messages.text.text()
    assert not window.messages.reconnect.isVisible()


@pytest.mark.slow
@pytest.mark.long
def test_bar_is_hidden_at_live_devices(live: tuple[MainWindow, object], qtbot: QtBot) -> None:
    window, _ = live
    assert not window.replay.isVisible()
    press(qtbot, window, Qt.Key.Key_Period)
    assert window.controls.light.isEnabled()
    assert window.recording_panel.record.isEnabled()


@pytest.fixture
def faulty(window: MainWindow, own_recording: Recording) -> Player:
    """A recording of faults that the window plays: one frame dark, one saturated, one without a wavefront."""
    path = own_recording.folder / "frames.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    began_s = lines[0]["host_time_s"]
    for index, line in enumerate(lines):
        line |= {"host_time_s": began_s + (0.5 * index if index < 5 else 10.0 + index), "rms_rad": 1.0 + index}
    lines[1] |= {"is_light_on": False, "problem": "no lenslet", "rms_rad": None, "valid": None}
    lines[2] |= {"problem": "the frame is saturated", "rms_rad": None, "valid": None}
    lines[4] |= {"problem": "the frame is blurred", "rms_rad": None, "valid": None}
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    player = Player(own_recording.folder)
    window.open(InstrumentFactory(player.acquisition, player.begin, player))
    return player


def test_timeline_shows_faults_and_a_click_goes_to_a_time(window: MainWindow, qtbot: QtBot, faulty: Player) -> None:
    bar, slider = window.replay, window.replay.slider
    qtbot.waitUntil(lambda: bar.faults.text() == "Bad frames: 3")
    qtbot.waitUntil(lambda: bar.play.text() == "Pause")
    bar.play.click()
    qtbot.waitUntil(lambda: bar.play.text() == "Play")
    menu = bar.faults.menu()
    assert menu is not None
    menu.aboutToShow.emit()
    texts = [action.text() for action in menu.actions()]
    assert texts == [
        "frame 1, 0.50 s, dark: the light was off",
        "frame 2, 1.00 s, saturated: the frame is saturated",
        "frame 4, 2.00 s, bad: the frame is blurred",
    ]
    menu.actions()[1].trigger()
    qtbot.waitUntil(partial(is_at, window, faulty, 2))
    click(qtbot, slider, QPoint(slider.width() * 15 // 17, 5))  # 15 of 17 s: the times have a gap
    qtbot.waitUntil(partial(is_at, window, faulty, 5))
    qtbot.waitUntil(lambda: bar.time.text() == "15.00 s")
    click(qtbot, slider, QPoint(slider.width() * 4 // 34, 5))
    qtbot.waitUntil(partial(is_at, window, faulty, 4))
    marks = part(picture(slider), QRect(0, slider.height() - 4, slider.width(), 3)).astype(int)
    for at_s, colour in ((0.5, theme.DIM), (1.0, theme.AMBER), (2.0, theme.RED)):
        x = round(3 + (slider.width() - 6) * at_s / 17)
        seen = marks[1, x - 2 : x + 3]  # the line of the position covers one
        assert np.abs(seen - [colour.red(), colour.green(), colour.blue()]).max(axis=1).min() < 3
    curve = part(picture(slider), QRect(slider.width() // 2, 0, slider.width() // 2, slider.height() - 8)).astype(int)
    blue = np.abs(curve - [theme.ACCENT.red(), theme.ACCENT.green(), theme.ACCENT.blue()]).max(axis=2) < 60
    assert blue.any()


def test_replayed_frame_has_its_own_light_name_and_time(window: MainWindow, qtbot: QtBot, faulty: Player) -> None:
    bar, panels = window.replay, window.panels
    qtbot.waitUntil(lambda: bar.play.text() == "Pause")
    bar.play.click()
    qtbot.waitUntil(lambda: bar.play.text() == "Play")
    for position, light in ((1, "Light was off"), (5, "Light was on")):
        bar.slider.setValue(position)
        qtbot.waitUntil(partial(is_at, window, faulty, position))
        qtbot.waitUntil(lambda light=light: window.controls.light.text() == light)  # type: ignore[misc] # mypy and defaults
    qtbot.waitUntil(lambda: window.shown.wavefront is not None)
    panels.wavefronts.menu.store.trigger()
    assert panels.wavefronts.menu.options.stored is not None
    assert panels.wavefronts.menu.options.stored.name == "that of frame 5"
    qtbot.waitUntil(lambda: panels.history._newest is not None and panels.history._newest[0] == pytest.approx(15.0))
    bar.slider.setValue(7)
    qtbot.waitUntil(lambda: panels.history._newest is not None and panels.history._newest[0] == pytest.approx(17.0))
    assert panels.history.history.series(RMS)[0][-2:] == pytest.approx([-2.0, 0.0])


def is_at(window: MainWindow, player: Player, position: int) -> bool:
    """True if this frame is shown and no move is under way."""
    return window.replay._wanted is None and window.replay._moving is None and player.position == position


@pytest.mark.slow
@pytest.mark.long
def test_damaged_frames_are_skipped_with_a_notice_and_marked(
    window: MainWindow, qtbot: QtBot, own_recording: Recording
) -> None:
    """Frame 3 has lost its pixels, frame 5 its line."""
    frame_file(own_recording.folder, 3).unlink()
    lines = (own_recording.folder / "frames.jsonl").read_bytes().splitlines(keepends=True)
    lines[5] = b"x" * (len(lines[5]) - 1) + b"\n"
    (own_recording.folder / "frames.jsonl").write_bytes(b"".join(lines))
    player = Player(own_recording.folder)
    window.open(InstrumentFactory(player.acquisition, player.begin, player))
    bar = window.replay
    qtbot.waitUntil(lambda: bar.play.text() == "Pause")
    bar.play.click()
    qtbot.waitUntil(lambda: bar.play.text() == "Play")
    bar.refresh()  # where it stopped: a slider that shows an earlier frame, maybe the first below, would not move there
    for start, step, end in ((2, bar.forth, 4), (4, bar.forth, 6), (6, bar.back, 4), (4, bar.back, 2)):
        bar.slider.setValue(start)
        qtbot.waitUntil(partial(is_at, window, player, start))
        bar.refresh()
        step.click()
        qtbot.waitUntil(partial(is_at, window, player, end))
        bar.refresh()
        assert bar.text.text() == f"frame {end} of {FRAMES - 1}"  # as in the messages below
    assert bar.slider.marked == {3, 5}
    assert "Frame 3 skipped: " in window.messages.log
    assert "Frame 5 skipped: " in window.messages.log
    bar.slider.setValue(3)  # a known one
    qtbot.waitUntil(partial(is_at, window, player, 4))
    assert (picture(bar.slider)[:, :, 0].astype(int) - picture(bar.slider)[:, :, 2] > 100).any()  # red
    before = window.status_line.shown
    bar.play.click()
    qtbot.waitUntil(lambda: window.status_line.shown > before + 2 * FRAMES)
    assert not window.controller.failure


def is_recorded_light_on(window: MainWindow) -> bool:
    acquisition = window.controller.acquisition
    return acquisition is not None and acquisition.status is not None and acquisition.status.is_light_on


@pytest.mark.usefixtures("runtime_folder")
def test_emergency_key_without_an_instrument_says_that_nothing_was_switched(window: MainWindow, qtbot: QtBot) -> None:
    press(qtbot, window, Qt.Key.Key_F12)
    qtbot.waitUntil(lambda: "no instrument of yours runs" in window.messages.text.text())
    assert is_recorded_light_on(window)


@pytest.mark.slow
@pytest.mark.usefixtures("runtime_folder")
def test_emergency_key_in_a_replay_switches_the_light_of_the_instrument_off(window: MainWindow, qtbot: QtBot) -> None:
    camera = FakeCamera()
    with served(camera):
        qtbot.waitUntil(lambda: camera.light.shines)
        press(qtbot, window, Qt.Key.Key_F12)
        qtbot.waitUntil(lambda: "The light of instrument is off" in window.messages.log)
        assert not camera.light.shines
    assert is_recorded_light_on(window)


def test_verdict_and_tool_tip_are_of_the_recording(window: MainWindow, qtbot: QtBot) -> None:
    qtbot.waitUntil(lambda: window.replay._overview is not None)
    assert window.verdict.text().startswith("REPLAY ")
    assert window.verdict.property("tone") == theme.tone(theme.TEXT)  # green is for a live frame
    bar, told = window.replay.slider, list[str]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(QToolTip, "showText", lambda _at, text, _on: told.append(text))
        place = QPoint(bar.width() - 3, 5)
        QApplication.sendEvent(bar, QHelpEvent(QEvent.Type.ToolTip, place, bar.mapToGlobal(place)))
    assert re.match(r"\d+\.\d\d s: RMS [\d.]+ rad, 35 valid lenslets\n", told[0])


def test_files_are_proposed_beside_the_recording_with_its_name(
    window: MainWindow, qtbot: QtBot, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def refuse(_parent: object, _title: str, proposed: str, *_: object) -> tuple[str, str]:
        asked.append(proposed)
        return "", ""

    monkeypatch.setattr(QFileDialog, "getSaveFileName", refuse)
    qtbot.waitUntil(lambda: window.shown.replayed is not None)
    window.panels.wavefronts.export()
    next(dock for dock in window.docks.docks if dock.panel is window.panels.history)._save_numbers()
    assert all(Path(name).parent == recording.folder.parent for name in asked)
    assert re.fullmatch(r"run frame \d wavefronts\.png", Path(asked[0]).name)
    assert re.fullmatch(r"run frame \d history\.csv", Path(asked[1]).name)
