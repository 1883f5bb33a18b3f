"""The window with an instrument in a process of its own: its start, its end, and who it goes on for."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from io import BufferedWriter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pytestqt.qtbot import QtBot
from support.command_line import run
from support.patience import HANG_S, wait_until
from support.recordings import record
from support.served import connected
from support.window_tools import choose_button, said_in

from app.acquisition.address import NAME, file_of, is_taken
from app.acquisition.remote.connection import Connection, reach
from app.acquisition.remote.own_instrument import OwnInstrument
from app.bench.config import Bench, load_bench, save_bench
from app.gui.shell.main_window import MainWindow
from app.recording.reader import Recording

pytestmark = pytest.mark.slow


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch, runtime_folder: Path) -> list[subprocess.Popen[bytes]]:
    """The processes that windows start for themselves."""
    assert runtime_folder.is_dir()
    processes: list[subprocess.Popen[bytes]] = []

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            processes.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    monkeypatch.setattr("app.commands.live.use_display", lambda: True)
    return processes


def live_window(monkeypatch: pytest.MonkeyPatch, bench: Path, act: Callable[[MainWindow], object], *more: str) -> int:
    """Run `svwfs live`, act on its window, and close that; returns the exit status."""

    def run_window(
        open_first: Callable[[MainWindow], None], *, make_for: Callable[[Bench], Connection], name: str
    ) -> int:
        window = MainWindow(make_for=make_for, name=name)
        window.show()
        try:
            open_first(window)
            act(window)
        finally:
            window.close()
        assert not window.controller.is_stuck
        return 0

    monkeypatch.setattr("app.gui.application.run_window", run_window)
    return run(monkeypatch, "live", "--bench", bench, *more)


@pytest.fixture
def stopped(
    monkeypatch: pytest.MonkeyPatch, started: list[subprocess.Popen[bytes]]
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """The processes that windows start, each stopped before it can be reached."""
    start = OwnInstrument.start

    def start_stopped(own: OwnInstrument, bench: Bench) -> subprocess.Popen[bytes]:
        process = start(own, bench)
        process.send_signal(signal.SIGSTOP)
        return process

    monkeypatch.setattr(OwnInstrument, "start", start_stopped)
    yield started
    for process in started:  # also of a test that failed
        process.kill()


@pytest.fixture
def other_toml(small_toml: Path, tmp_path: Path) -> Path:
    other = tmp_path / "other.toml"
    save_bench(other, load_bench(small_toml, ("registration.warp=affine",)))
    return other


def is_measured(window: MainWindow) -> bool:
    return window.verdict.valid == "35 of 35"


def is_dark(window: MainWindow) -> bool:
    status = window.controller.status
    return status is not None and not status.is_light_on


def connection_of(window: MainWindow) -> Connection:
    connection = window.controller.connection
    assert connection is not None
    assert connection.has_control
    return connection


def test_log_begins_anew_and_tells_a_crash_of_windows(
    small_toml: Path, runtime_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On Windows a process writes where the file stood that it was given, and crashes with such a code."""
    assert runtime_folder.is_dir()
    file_of(NAME, "log").write_text("of the last one")
    begun: list[int] = []

    def start(*_: str, output: BufferedWriter) -> object:
        begun.append(os.lseek(output.fileno(), 0, os.SEEK_CUR))
        output.write(b"access violation")
        return SimpleNamespace(poll=lambda: 0xC0000005, returncode=0xC0000005)

    monkeypatch.setattr("app.acquisition.remote.own_instrument.start_child", start)
    with OwnInstrument() as own:
        own.start(load_bench(small_toml))
    assert begun == [0]
    assert capsys.readouterr().err == "access violation"


@pytest.mark.long
def test_window_runs_its_instrument_in_a_process_that_ends_with_it(
    started: list[subprocess.Popen[bytes]], small_toml: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    defaults: list[str] = []

    def act(window: MainWindow) -> None:
        qtbot.waitUntil(lambda: is_measured(window))
        assert connection_of(window).address.process == started[-1].pid != os.getpid()
        assert "--trust-library" not in str(started[-1].args)  # the window has asked
        assert "attached" not in window.windowTitle()
        assert window.controller.left == ""
        asked = choose_button(monkeypatch, "Stop instrument", defaults)
        window.quit()
        qtbot.waitUntil(lambda: not window.isVisible())
        assert defaults == ["Stop instrument"]
        assert "nothing is recorded" in asked[0]
        assert started[-1].poll() == 0  # the window has waited for the end

    assert live_window(monkeypatch, small_toml, act) == 0
    (process,) = started
    assert process.poll() == 0
    assert not is_taken(NAME)


@pytest.mark.long
def test_instrument_of_a_window_goes_on_if_its_user_says_so(
    started: list[subprocess.Popen[bytes]],
    small_toml: Path,
    tmp_path: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    defaults: list[str] = []

    def act(window: MainWindow) -> None:
        qtbot.waitUntil(lambda: is_measured(window))
        connection_of(window).start_recording(tmp_path / "run 1").result(HANG_S)
        qtbot.waitUntil(lambda: "run 1" in window.recording_bar.text.text())
        asked = choose_button(monkeypatch, "Keep running", defaults)
        window.quit()
        assert defaults == ["Cancel"]  # no key ends a recording by mistake
        assert "recording run 1 continues" in asked[0]
        qtbot.waitUntil(lambda: not window.isVisible())
        assert window.controller.left == "the instrument keeps running"

    assert live_window(monkeypatch, small_toml, act) == 0
    assert started[0].poll() is None
    log = file_of(NAME, "log")
    goes_on = f"the instrument keeps running as process {started[0].pid}; its messages go to {log}\n"
    assert goes_on in capsys.readouterr().out

    def attach(window: MainWindow) -> None:
        qtbot.waitUntil(lambda: "an instrument named instrument is running already" in said_in(window))
        window.messages.accept.click()
        qtbot.waitUntil(lambda: is_measured(window))
        assert "attached" in window.windowTitle()
        assert connection_of(window).address.process == started[0].pid

    assert live_window(monkeypatch, small_toml, attach) == 0
    assert len(started) == 1
    with connected("notebook") as notebook:
        assert notebook.has_control
        wait_until(lambda: notebook.newest is not None)
        started[0].send_signal(signal.SIGSEGV)
        wait_until(lambda: not notebook.is_alive)
    assert started[0].wait(HANG_S) == -signal.SIGSEGV
    assert "Segmentation fault" in log.read_text()  # its last words, though nobody was there
    assert sorted(each.name for each in log.parent.iterdir()) == ["instrument.lock", "instrument.log"]


@pytest.mark.long
def test_another_bench_and_a_new_start_have_processes_of_their_own(
    started: list[subprocess.Popen[bytes]],
    small_toml: Path,
    other_toml: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def act(window: MainWindow) -> None:
        qtbot.waitUntil(lambda: is_measured(window))
        window.benches.open(str(other_toml))
        qtbot.waitUntil(lambda: len(started) == 2)
        assert started[0].poll() == 0  # two must not have the devices
        assert window.controls.light.text() == "Light off"
        qtbot.waitUntil(lambda: is_measured(window))
        assert connection_of(window).bench == load_bench(other_toml)
        window.light.switch(is_on=False)
        qtbot.waitUntil(lambda: is_dark(window))
        connection_of(window).start_recording(other_toml.parent / "run 1").result(HANG_S)
        qtbot.waitUntil(lambda: "run 1" in window.recording_bar.text.text())
        started[1].send_signal(signal.SIGSEGV)
        qtbot.waitUntil(lambda: f"the instrument's process {started[1].pid} was ended by sigsegv" in said_in(window))
        window.controller.take_control()
        assert "runs the instrument itself" not in window.messages.log
        window.messages.reconnect.click()
        qtbot.waitUntil(lambda: (status := window.controller.status) is not None and status.is_running)
        assert "its instrument has died: recover completes it" in window.messages.log.lower()
        assert not window.recording_panel.record.isChecked()
        assert connection_of(window).bench == load_bench(other_toml)
        qtbot.waitUntil(lambda: window.controller.is_settled)
        assert is_dark(window)  # as its user left it
        window.recording_bar.recover.click()
        qtbot.waitUntil(lambda: "Recording run 1 is complete" in window.messages.log)
        assert Recording(other_toml.parent / "run 1").is_complete
        assert window.recording_bar.recover.isHidden()

    assert live_window(monkeypatch, small_toml, act) == 0
    assert [each.poll() for each in started] == [0, -signal.SIGSEGV, 0]
    assert "Segmentation fault" in capfd.readouterr().err  # where it crashed
    assert not is_taken(NAME)


@pytest.mark.long
def test_bench_that_the_window_of_a_recording_opens_has_a_process(
    started: list[subprocess.Popen[bytes]],
    small_toml: Path,
    other_toml: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    record(small_toml, folder := other_toml.parent / "run", frames=3)
    started.clear()

    def act(window: MainWindow) -> None:
        window.benches.open(str(other_toml))
        qtbot.waitUntil(lambda: is_measured(window))
        assert connection_of(window).address.process == started[0].pid

    assert live_window(monkeypatch, small_toml, act, "--replay", str(folder)) == 0
    assert [each.poll() for each in started] == [0]


@pytest.mark.long
def test_instrument_of_a_window_goes_on_for_the_client_that_has_control(
    started: list[subprocess.Popen[bytes]],
    small_toml: Path,
    other_toml: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def act(window: MainWindow) -> None:
        qtbot.waitUntil(lambda: is_measured(window))
        notebook.append(reach("notebook", takes_control=False))
        notebook[0].take_control().result(HANG_S)
        qtbot.waitUntil(lambda: "this program only watches: notebook" in said_in(window))
        window.benches.open(str(other_toml))
        qtbot.waitUntil(lambda: f"process {started[0].pid} keeps running: its devices are in use" in said_in(window))
        window.benches.open(str(other_toml))  # again
        qtbot.waitUntil(lambda: not window.benches._reading.is_busy)
        assert window.controller.left == "the instrument keeps running"

    notebook: list[Connection] = []
    assert live_window(monkeypatch, small_toml, act) == 0
    assert notebook[0].has_control
    assert [each.poll() for each in started] == [None]
    notebook[0].shut_down().result(HANG_S)
    notebook[0].close()
    assert started[0].wait(HANG_S) == 0


@pytest.mark.posix
def test_window_acts_while_its_instrument_starts(
    stopped: list[subprocess.Popen[bytes]], small_toml: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing waits for the process, and the window can be closed before it is reached."""

    def act(window: MainWindow) -> None:
        qtbot.waitUntil(lambda: "starting the instrument" in said_in(window))
        assert not window.controller.is_silent
        assert window.controller.notice == ""
        qtbot.wait(2500)  # until an instrument that was reached would count as silent
        assert "starting the instrument" in said_in(window)
        window.controller.take_control()
        assert "instrument is starting: wait until it is reached" in window.messages.log
        asked = choose_button(monkeypatch, "Keep running")
        stopped[0].send_signal(signal.SIGCONT)
        window.quit()
        qtbot.waitUntil(lambda: not window.isVisible())
        assert not asked  # what does not run yet cannot go on

    assert live_window(monkeypatch, small_toml, act) == 0
    assert stopped[0].poll() is not None
    assert not is_taken(NAME)


@pytest.mark.posix
@pytest.mark.parametrize("is_read", [True, False])
def test_light_that_is_switched_off_while_the_instrument_starts_never_shines(
    stopped: list[subprocess.Popen[bytes]],
    small_toml: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
    *,
    is_read: bool,
) -> None:
    def act(window: MainWindow) -> None:
        if is_read:
            qtbot.waitUntil(lambda: window.controller.acquisition is not None)
        window.light.switch(is_on=True)
        assert window.light.is_switching_off is is_read  # the command that lights waits already
        qtbot.waitUntil(lambda: window.controller.acquisition is not None)
        stopped[0].send_signal(signal.SIGCONT)
        seen: list[bool] = []

        def is_settled() -> bool:
            status = window.controller.status
            seen.append(status is not None and status.is_light_on)
            return status is not None and window.controller.is_settled

        qtbot.waitUntil(is_settled)
        assert is_dark(window)
        assert not any(seen)

    assert live_window(monkeypatch, small_toml, act) == 0
