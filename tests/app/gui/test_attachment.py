"""The window on an instrument of another process: it shows the same, tells who has control, and asks when it leaves."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from PyQt6.QtWidgets import QMessageBox
from pytestqt.qtbot import QtBot
from support.command_line import run
from support.gui_bench import FakeCamera
from support.patience import HANG_S, wait_until
from support.served import connected, served
from support.window_tools import MakeWindow, wait_for_wavefront

from app.acquisition.instrument import Instrument
from app.acquisition.place import NAME, is_taken, taken_place
from app.acquisition.remote.connection import Connection
from app.acquisition.remote.server import Server
from app.gui.shell.main_window import MainWindow
from app.gui.widgets.presentation import NOTHING

pytestmark = pytest.mark.slow


@pytest.fixture
def camera() -> FakeCamera:
    return FakeCamera()


@pytest.fixture
def server(camera: FakeCamera, runtime_folder: Path) -> Iterator[Server]:
    assert runtime_folder.is_dir()
    with served(camera) as running:
        yield running


@pytest.fixture
def window(make_window: MakeWindow, server: Server, qtbot: QtBot) -> MainWindow:
    assert server.place.process
    made = make_window()
    made.open(lambda: Connection("window"), lambda _: ())
    wait_for_wavefront(qtbot, made)
    return made


def told(window: MainWindow) -> str:
    return window.messages.text.text().lower()


def answer(monkeypatch: pytest.MonkeyPatch, label: str) -> list[str]:
    """Click a button of the next message box; returns the questions asked."""
    asked: list[str] = []

    def click(box: QMessageBox) -> int:
        asked.append(box.text())
        next(each for each in box.buttons() if each.text().replace("&", "") == label).click()
        return 0

    monkeypatch.setattr(QMessageBox, "exec", click)
    return asked


@pytest.mark.long
def test_window_shows_and_commands_the_instrument(window: MainWindow, server: Server, qtbot: QtBot) -> None:
    assert window.windowTitle().endswith(", attached")
    assert f"in process {server.place.process}" in window.status_line.devices.toolTip()
    assert "window" in window.status_line.devices.toolTip()
    window.controls.requested.emit("dark", 3)
    qtbot.waitUntil(lambda: "dark taken" in told(window))
    qtbot.waitUntil(lambda: window.controller.is_settled)
    assert window.light.is_kept_off is False


def test_window_that_watches_says_who_has_control_and_takes_it(
    make_window: MakeWindow, server: Server, qtbot: QtBot
) -> None:
    with connected("notebook"):
        window = make_window()
        window.open(lambda: Connection("window"), lambda _: ())
        qtbot.waitUntil(lambda: "this window only watches: notebook" in told(window))
        window.messages.control.click()
        qtbot.waitUntil(lambda: "watches" not in told(window))
        assert window.messages.control.isHidden()
        connection = window.attachment.connection
        assert connection is not None
        assert connection.has_control
    assert server.acquisition.is_alive


@pytest.mark.parametrize(("label", "goes_on"), [("It goes on", True), ("End it", False)])
def test_closing_asks_whether_the_instrument_goes_on(
    window: MainWindow, server: Server, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, *, label: str, goes_on: bool
) -> None:
    asked = answer(monkeypatch, "Cancel")
    window.quit()
    assert asked == ["Does the instrument go on without this window?"]
    assert window.isVisible()
    answer(monkeypatch, label)
    window.quit()
    qtbot.waitUntil(lambda: not window.isVisible())
    qtbot.waitUntil(lambda: server.acquisition.is_alive is goes_on)
    if goes_on:
        assert window.controller.left == "the instrument goes on"


@pytest.mark.long
def test_silence_of_the_instrument_is_shown_until_it_answers(
    window: MainWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, controls = window.status_line, window.controls
    with monkeypatch.context() as silence:
        silence.setattr("app.acquisition.remote.connection._SILENT_S", -1.0)
        qtbot.waitUntil(lambda: line.devices.text() == "silent")
        qtbot.waitUntil(lambda: "does not answer: if that lasts, end it" in told(window))
        assert not controls.isEnabled()
        assert controls.light.text() == "Light not\nreached"
        assert line.rate.text() == NOTHING
    qtbot.waitUntil(lambda: line.devices.text() == "running")
    assert controls.isEnabled()
    assert controls.light.text() == "Light on"


@pytest.mark.long
def test_commands_of_a_window_that_watches_are_refused_with_a_sentence(
    make_window: MakeWindow, server: Server, camera: FakeCamera, qtbot: QtBot, tmp_path: Path
) -> None:
    with connected("notebook") as notebook:
        window = make_window()
        window.open(lambda: Connection("window"), lambda _: ())
        wait_for_wavefront(qtbot, window)
        bar, panel = window.recording_bar, window.recording_panel

        def is_refused(act: Callable[[], object]) -> None:
            window.messages.clear_notice()
            window.update_text()
            act()
            qtbot.waitUntil(lambda: "this program only watches: notebook" in told(window))

        camera.period_s = 0.1
        reference = notebook.submit(Instrument.take_reference, 200)
        qtbot.waitUntil(lambda: "taking the reference" in window._activity.text)
        is_refused(window.messages.escape)
        notebook.cancel()
        assert reference.exception(HANG_S) is not None
        notebook.start_recording(tmp_path / "run").result(HANG_S)
        qtbot.waitUntil(panel.record.isChecked)
        is_refused(panel.record.click)
        is_refused(lambda: bar.stop_after.entered.emit(5.0))
        window.attachment.end_instrument()
        qtbot.waitUntil(lambda: "this window only watches: notebook" in told(window))
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
        window.open(lambda: Connection("window"), lambda _: ())
        wait_for_wavefront(qtbot, window)
        first.end()
        qtbot.waitUntil(lambda: "the instrument was shut down" in told(window))
    with served(FakeCamera()) as second:
        window.messages.reconnect.click()
        wait_for_wavefront(qtbot, window)
        connection = window.attachment.connection
        assert connection is not None
        assert connection.has_control
        qtbot.waitUntil(lambda: "shut down" not in told(window))
        assert f"in process {second.place.process}" in window.status_line.devices.toolTip()
        window.controls.requested.emit("dark", 3)
        qtbot.waitUntil(lambda: "dark taken" in told(window))


@pytest.mark.long
@pytest.mark.usefixtures("runtime_folder")
def test_window_starts_an_instrument_of_its_own(
    make_window: MakeWindow,
    small_toml: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run_window(open_first: Callable[[MainWindow], None]) -> int:
        window = make_window()
        open_first(window)
        qtbot.waitUntil(lambda: window.status_line.valid.text() == "35 of 35")
        connection = window.attachment.connection
        assert connection is not None
        assert connection.has_control
        assert connection.place.process != os.getpid()
        connection.shut_down()
        qtbot.waitUntil(lambda: "the instrument was shut down" in told(window))
        return 0

    started = list[subprocess.Popen[bytes]]()

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            started.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    monkeypatch.setattr("app.commands.live.use_display", lambda: True)
    monkeypatch.setattr("app.gui.application.run_window", run_window)
    arguments = ("live", "--own-process", "--bench", small_toml)
    with taken_place() as place:
        place.announce()
        assert run(monkeypatch, *arguments) == 1
    assert "runs as instrument already" in capsys.readouterr().err
    assert run(monkeypatch, *arguments) == 0
    wait_until(lambda: not is_taken(NAME))
    assert run(monkeypatch, *arguments, "--seconds", "1") == 2
    assert "--own-process is for a window" in capsys.readouterr().err
    assert run(monkeypatch, *arguments, "--set", "camera.exposure_s=-1") == 2
    monkeypatch.setattr("app.commands.live.is_taken", lambda _: False)  # another one came between
    with taken_place():
        assert run(monkeypatch, *arguments) == 1
    assert "the instrument's process has ended: svwfs: an instrument runs as" in capsys.readouterr().err
    assert [each.wait(HANG_S) for each in started] == [0, 1]  # shut down, and refused


def test_end_of_the_instrument_is_told_and_reconnecting_says_that_none_runs(
    window: MainWindow, server: Server, qtbot: QtBot
) -> None:
    window.attachment.end_instrument()
    window.messages.accept.click()
    qtbot.waitUntil(lambda: "the instrument was shut down" in told(window))
    qtbot.waitUntil(lambda: not server.acquisition.is_alive)
    assert window.controller.left == "the instrument was shut down"
    qtbot.wait(300)
    window.messages.reconnect.click()
    qtbot.waitUntil(lambda: "no instrument runs" in told(window))


def test_a_window_with_its_own_instrument_has_nothing_to_leave(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    asked = answer(monkeypatch, "Cancel")
    assert not window.attachment.ask_to_leave(lambda: None)
    assert not asked
    for command in (window.attachment.take_control, window.attachment.end_instrument):
        command()
        qtbot.waitUntil(lambda: "runs the instrument itself" in told(window))
