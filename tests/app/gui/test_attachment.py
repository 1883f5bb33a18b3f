"""The window on an instrument of another process: it shows the same, tells who has control, and asks when it leaves."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PyQt6.QtCore import QEvent, QPoint
from PyQt6.QtGui import QHelpEvent
from PyQt6.QtWidgets import QApplication, QToolTip
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import HANG_S, own_time, wait_until
from support.served import connected, newest, served
from support.window_tools import MakeWindow, choose_button, said_in, wait_for_wavefront

from app.acquisition.address import CLOSING_S, NAME, is_taken
from app.acquisition.remote.connection import Connection, reach
from app.acquisition.remote.own_connection import OwnConnection
from app.acquisition.remote.server import Server
from app.acquisition.worker import Acquisition
from app.errors import RunError
from app.gui.application import _raise_failure
from app.gui.panels.coefficients import CoefficientsPanel
from app.gui.panels.controls import ControlsPanel
from app.gui.panels.history import HistoryPanel
from app.gui.panels.layers import LayersPanel
from app.gui.panels.lenslet import LensletPanel
from app.gui.panels.panel import Panel
from app.gui.panels.quality import QualityPanel
from app.gui.panels.wavefronts import WavefrontPanel
from app.gui.shell.main_window import MainWindow
from app.gui.widgets.presentation import NOTHING
from app.recording.reader import Recording
from app.results.player import InstrumentFactory
from app.results.view_maps import Quantity
from app.run_facts import MAIN
from reconstruction.reconstructor import Reconstructor
from reconstruction.runtime.child_process import start_child

pytestmark = pytest.mark.slow


@pytest.fixture
def window(make_window: MakeWindow, server: Server, qtbot: QtBot) -> MainWindow:
    assert server.address.process
    made = make_window()
    made.open(InstrumentFactory(lambda: reach("window"), lambda _: ()))
    wait_for_wavefront(qtbot, made)
    return made


def test_window_prepares_no_estimator_to_show_frames(
    server: Server, make_window: MakeWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With every panel open but the layers, whose search needs one."""
    with connected("notebook") as notebook:
        newest(notebook)
        prepare = Reconstructor.__init__
        prepared: list[object] = []

        def noted(made: Reconstructor, *arguments: Any, **named: Any) -> None:
            prepared.append(made)
            prepare(made, *arguments, **named)

        monkeypatch.setattr(Reconstructor, "__init__", noted)
        window = make_window()
        window.open(InstrumentFactory(lambda: reach("window", takes_control=False), lambda _: ()))
        wait_for_wavefront(qtbot, window)
        panels = [panel for panel in window.panels if not isinstance(panel, LayersPanel | ControlsPanel)]
        next(dock for dock in window.docks.docks if dock.panel is window.panels.layers).hide()
        window.docks.float_panels(*panels)
        window.panels.lenslet.inspect(4, 6)
        shown: set[type] = set()
        for panel in panels:
            show = panel.show_result

            def note(found: Any, of: Panel = panel, show: Callable[[Any], None] = show) -> None:
                shown.add(type(of))
                show(found)

            monkeypatch.setattr(panel, "show_result", note)
        asked = {WavefrontPanel, CoefficientsPanel, LensletPanel, QualityPanel, HistoryPanel}
        for quantity in Quantity:
            window.panels.wavefronts.choice.setCurrentText(quantity)
            shown.clear()
            qtbot.waitUntil(lambda: shown >= asked)
        assert not prepared
        assert notebook.newest is not None
        assert notebook.newest.wavefront is not None
        assert np.isfinite(notebook.newest.wavefront.sigma()).all()
        assert not prepared
    assert server.acquisition.is_alive


@pytest.mark.long
def test_window_shows_and_commands_the_instrument(window: MainWindow, server: Server, qtbot: QtBot) -> None:
    assert window.windowTitle().endswith(", attached")
    assert f"instrument: process {server.address.process}, alive" in window.status_line.devices.toolTip()
    assert "window" in window.status_line.devices.toolTip()
    window.controls.requested.emit("dark", 3)
    qtbot.waitUntil(lambda: "dark taken" in said_in(window))
    qtbot.waitUntil(lambda: window.controller.is_settled)
    assert window.light.is_kept_off is False


def test_window_that_watches_says_who_has_control_and_takes_it(
    make_window: MakeWindow, server: Server, qtbot: QtBot
) -> None:
    with connected("notebook"):
        window = make_window()
        window.open(InstrumentFactory(lambda: reach("window"), lambda _: ()))
        qtbot.waitUntil(lambda: "this program only watches: notebook" in said_in(window))
        controls, panel = window.controls, window.recording_panel
        commanding = controls.start, controls.dark, controls.exposure, controls.refine, panel.record, panel.keep
        qtbot.waitUntil(controls.light.isEnabled)  # any client may switch it off
        assert not any(each.isEnabled() for each in commanding)
        assert server.acquisition.status is not None
        window.show_status(server.acquisition.status)  # a status enables what the devices have
        assert not any(each.isEnabled() for each in commanding)
        assert controls.light.isEnabled()
        told: list[str] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(QToolTip, "showText", lambda _at, text, _on: told.append(text))
            for each in (controls.dark, controls.start, panel.record):
                QApplication.sendEvent(each, QHelpEvent(QEvent.Type.ToolTip, QPoint(2, 2), QPoint(2, 2)))
        assert [text.startswith("this program only watches: notebook") for text in told] == [True] * 3
        window.messages.control.click()
        qtbot.waitUntil(lambda: "watches" not in said_in(window))
        qtbot.waitUntil(lambda: all(each.isEnabled() for each in commanding))
        assert window.messages.control.isHidden()
        connection = window.controller.connection
        assert connection is not None
        assert connection.has_control
    assert server.acquisition.is_alive


@pytest.mark.parametrize(("label", "goes_on"), [("Keep running", True), ("Stop instrument", False)])
def test_closing_asks_whether_the_instrument_goes_on(
    window: MainWindow, server: Server, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, *, label: str, goes_on: bool
) -> None:
    asked = choose_button(monkeypatch, "Cancel")
    window.quit()
    (question,) = asked
    assert question.startswith("Keep the instrument running without this window?")
    assert window.isVisible()
    choose_button(monkeypatch, label)
    window.quit()
    qtbot.waitUntil(lambda: not window.isVisible())
    qtbot.waitUntil(lambda: server.acquisition.is_alive is goes_on)
    if goes_on:
        assert window.controller.left == "the instrument keeps running"


def test_window_of_a_stopped_instrument_closes_soon(window: MainWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as stopped:
        stopped.setattr("app.acquisition.remote.connection._SILENT_S", -1.0)
        stopped.setattr("app.gui.shell.controller._SILENT_S", 0.2)
        stopped.setattr(Connection, "is_alive", True)
        with own_time() as elapsed_s:
            window.controller.close(lambda: None)
            assert elapsed_s() < CLOSING_S / 2
        assert window.controller.is_stuck
        with pytest.raises(RunError, match="does not answer: if that lasts, end it, and see whether the light is off"):
            _raise_failure(window, is_interrupted=False)


@pytest.mark.long
def test_silence_of_the_instrument_is_shown_until_it_answers(
    window: MainWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, controls = window.status_line, window.controls
    with monkeypatch.context() as silence:
        silence.setattr("app.acquisition.remote.connection._SILENT_S", -1.0)
        qtbot.waitUntil(lambda: line.devices.text() == "instrument frozen")
        qtbot.waitUntil(lambda: "does not answer: if that lasts, end it" in said_in(window))
        assert not controls.isEnabled()
        assert controls.light.text() == "Light not reached"
        assert line.rate.text() == NOTHING
    qtbot.waitUntil(lambda: line.devices.text() == "running")
    assert controls.isEnabled()
    assert controls.light.text() == "Light on"


@pytest.mark.long
def test_commands_of_a_window_that_watches_are_refused_with_a_sentence(
    make_window: MakeWindow, server: Server, fake_camera: FakeCamera, qtbot: QtBot, tmp_path: Path
) -> None:
    with connected("notebook") as notebook:
        window = make_window()
        window.open(InstrumentFactory(lambda: reach("window"), lambda _: ()))
        wait_for_wavefront(qtbot, window)
        bar, panel = window.recording_bar, window.recording_panel

        def is_refused(act: Callable[[], object]) -> None:
            window.messages.clear_notice()
            window.update_text()
            act()
            qtbot.waitUntil(lambda: "this program only watches: notebook" in said_in(window))

        fake_camera.period_s = 0.1
        reference = notebook.take_reference(200)
        qtbot.waitUntil(lambda: "taking the reference" in window._activity.text)
        is_refused(window.messages.escape)
        notebook.cancel()
        assert reference.exception(HANG_S) is not None
        notebook.start_recording(tmp_path / "run").result(HANG_S)
        qtbot.waitUntil(panel.record.isChecked)
        assert not panel.record.isEnabled()
        is_refused(lambda: bar.stop_after.entered.emit(5.0))
        window.quit()  # asks nothing: the instrument goes on for the notebook
        qtbot.waitUntil(lambda: not window.isVisible())
    assert server.acquisition.is_alive


@pytest.mark.long
def test_window_goes_on_with_an_instrument_that_was_started_again(
    make_window: MakeWindow, runtime_folder: Path, qtbot: QtBot
) -> None:
    assert runtime_folder.is_dir()
    window = make_window()
    with served(FakeCamera()) as first:
        window.open(InstrumentFactory(lambda: reach("window"), lambda _: ()))
        wait_for_wavefront(qtbot, window)
        first.end()
        qtbot.waitUntil(lambda: "the instrument was shut down" in said_in(window))
    with served(FakeCamera()) as second:
        window.messages.reconnect.click()
        wait_for_wavefront(qtbot, window)
        connection = window.controller.connection
        assert connection is not None
        assert connection.has_control
        qtbot.waitUntil(lambda: "shut down" not in said_in(window))
        assert f"instrument: process {second.address.process}, alive" in window.status_line.devices.toolTip()
        window.controls.requested.emit("dark", 3)
        qtbot.waitUntil(lambda: "dark taken" in said_in(window))


def test_recording_goes_on_when_the_window_opens_another_bench(
    window: MainWindow, server: Server, qtbot: QtBot, tmp_path: Path
) -> None:
    server.acquisition.start_recording(tmp_path / "run 1").result(HANG_S)
    qtbot.waitUntil(lambda: "run 1" in window.recording_bar.text.text())
    window.open(InstrumentFactory(partial(Acquisition, BENCH, opener(FakeCamera()))))
    qtbot.waitUntil(lambda: window.controller.status is not None)
    window.recording_bar.refresh()
    assert "run 1" not in window.recording_bar.text.text()
    assert "cut off" not in window.messages.log
    state = server.acquisition.recording
    assert state is not None
    assert state.stage == "recording"


def test_end_of_the_instrument_is_told_and_reconnecting_says_that_none_runs(
    window: MainWindow, server: Server, qtbot: QtBot
) -> None:
    server.end()
    qtbot.waitUntil(lambda: "the instrument was shut down" in said_in(window))
    qtbot.waitUntil(lambda: not server.acquisition.is_alive)
    assert window.controller.left == "the instrument was shut down"
    qtbot.wait(300)
    window.messages.reconnect.click()
    qtbot.waitUntil(lambda: "no instrument runs" in said_in(window))


def test_a_window_that_runs_the_instrument_itself_has_nothing_to_leave(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    asked = choose_button(monkeypatch, "Cancel")
    assert not window.controller.ask_to_leave(lambda: None, window)
    assert not asked
    window.controller.take_control()
    qtbot.waitUntil(lambda: "runs the instrument itself" in said_in(window))


def test_result_that_cannot_be_sent_is_one_sentence_and_the_next_is_shown(
    window: MainWindow, server: Server, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as unsendable:
        unsendable.setattr(server.acquisition, "_light_state", lambda: {1, 2})  # no plain data
        sentence = "this frame cannot be shown: a set cannot be sent to another process"
        qtbot.waitUntil(lambda: said_in(window) == sentence)
        assert window.shown.wavefront is None
        assert server.acquisition.is_alive
    qtbot.waitUntil(lambda: window.shown.wavefront is not None)
    qtbot.waitUntil(lambda: "cannot be" not in said_in(window))
    assert window.messages.log.lower().count("cannot be sent") == 1


@pytest.fixture
def gone(quick_toml: Path, runtime_folder: Path, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`svwfs serve` in a process, to be killed."""
    with (tmp_path / "log").open("wb") as log:
        process = start_child(MAIN, "serve", "--bench", str(quick_toml), output=log)
    assert runtime_folder.is_dir()
    wait_until(lambda: is_taken(NAME))
    yield process
    process.kill()
    process.wait()


@pytest.mark.long
def test_killed_instrument_is_no_dead_end(
    gone: subprocess.Popen[bytes], make_window: MakeWindow, tmp_path: Path, qtbot: QtBot
) -> None:
    """Nothing untrue is said of its light; the window recovers its recording, and starts another instrument."""
    window = make_window()
    window.open(InstrumentFactory(lambda: reach("window"), lambda _: ()))
    qtbot.waitUntil(lambda: window.shown.wavefront is not None)
    bar = window.recording_bar
    bar.recordings_folder = tmp_path
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: (state := bar._controller.acquisition) is not None and bool(state.recording))
    bar.name.setText("mine")

    def frames() -> int:
        acquisition = window.controller.acquisition
        return 0 if acquisition is None or acquisition.recording is None else acquisition.recording.frames

    qtbot.waitUntil(lambda: frames() > 0)
    gone.kill()
    qtbot.waitUntil(lambda: "should be off; if it shines, switch it off by hand" in said_in(window))
    assert said_in(window).endswith("reconnect (ctrl+r)")
    assert "shut down" not in window.messages.log
    assert window.controls.light.text() == "Light not reached"
    qtbot.waitUntil(lambda: not bar.recover.isHidden())
    assert not window.recording_panel.record.isChecked()
    assert bar.replay.isHidden()
    bar.recover.click()
    qtbot.waitUntil(lambda: not bar.replay.isHidden())
    qtbot.waitUntil(lambda: bar.folder is not None and bar.folder.name.endswith("-mine"))
    assert bar.folder is not None
    assert Recording(bar.folder).is_complete
    window.messages.alarm("")
    window.messages.reconnect.click()
    qtbot.waitUntil(lambda: "no instrument runs: start one with svwfs serve" in said_in(window))
    qtbot.wait(500)  # the question stays
    assert window.messages.accept.text() == "Start it here"
    window.messages.accept.click()
    qtbot.waitUntil(lambda: window.shown.measurement is not None and window.shown.wavefront is not None)
    assert not window.controller.failure


def test_window_that_started_its_instrument_retakes_control(
    server: Server, runtime_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A busy computer kept it silent for too long; a window that only attached watches from then on."""
    process: Any = SimpleNamespace(pid=os.getpid(), poll=lambda: None, wait=lambda _: None, returncode=None)
    own = OwnConnection(BENCH, NAME, process, log=runtime_folder, forget_bench=lambda: None)
    own.wait()
    assert own.has_control
    with monkeypatch.context() as silence:
        silence.setattr("app.acquisition.remote.server._SILENT_S", -1.0)
        wait_until(lambda: not server._clients)
    wait_until(lambda: bool(server._clients))
    own.set_running(True).result(HANG_S)
    own.goes_on = True
    own.close()
    with connected() as attached:
        assert attached.has_control
        with monkeypatch.context() as silence:
            silence.setattr("app.acquisition.remote.server._SILENT_S", -1.0)
            wait_until(lambda: not attached.has_control)
        wait_until(lambda: attached.name in attached.clients)
        assert not attached.has_control
    assert server.acquisition.is_alive
