"""Instrument and clients as programs: what each of them does when another is killed, stopped or frozen.

`SVWFS_KILLS=100` repeats each death.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from support.command_line import run
from support.patience import HANG_S, own_time, wait_until
from support.posix import SIGKILL, SIGSTOP
from support.served import connected

from app.acquisition.address import NAME, is_taken, runtime_folder
from app.acquisition.remote.connection import Connection, reach
from app.bench.config import load_bench, save_bench
from app.errors import RunError
from app.recording.folder import FRAME_LINES
from app.recording.reader import Recording
from reconstruction.quality.verdict import Fault

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("runtime_folder"), pytest.mark.posix]

KILLS = int(os.environ.get("SVWFS_KILLS", "1"))
CRASHES = [signal.SIGSEGV] if KILLS > 1 else []  # for the others the same as a kill

CLIENT = """
import sys, time
from pathlib import Path
from app.acquisition.remote.connection import reach
connection = reach("client")
while connection.newest is None or connection.newest.wavefront is None:
    time.sleep(0.01)
if connection.has_control:
    connection.start_recording(Path(sys.argv[1])).result()
print("sees", flush=True)
time.sleep(600)
"""
WINDOW = """
import sys
from pathlib import Path
from app.acquisition.start_up import HeadlessRun
from app.acquisition.remote.connection import reach
from app.gui.application import headless_steps, run_window
from app.results.player import InstrumentFactory

connection = reach("client")

def steps(window):
    yield from headless_steps(window, HeadlessRun(connection), 0.5)
    connection.start_recording(Path(sys.argv[1])).result()
    print("sees", flush=True)
    while True:
        yield

access = InstrumentFactory(lambda: connection, begin=lambda _: ())
run_window(lambda window: window.open(access), steps=steps)
"""

OWN_WINDOW = """
import sys
from app.commands.live import bench_window
bench_window(sys.argv[1], (), "instrument", trust=True, offers_last=False)
"""


@contextmanager
def program(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as made:  # noqa: S603 - this interpreter
        try:
            yield made
        finally:
            made.send_signal(signal.SIGCONT)
            made.kill()


@contextmanager
def instrument(bench: Path) -> Iterator[subprocess.Popen[str]]:
    code = "import sys; from app.cli import main; sys.argv = ['svwfs', *sys.argv[1:]]; main()"
    with program("-c", code, "serve", "--bench", str(bench)) as made:
        assert made.stdout is not None
        assert f"runs as process {made.pid}" in made.stdout.readline()
        wait_until(lambda: is_taken(NAME))
        yield made


def nothing_is_left() -> bool:
    return [each.name for each in runtime_folder().iterdir()] == ["instrument.lock"]


def wait_for_wavefront(connection: Connection) -> None:
    wait_until(lambda: connection.newest is not None and connection.newest.wavefront is not None)


def wait_for_more(connection: Connection, frames: int = 3) -> None:
    enough = connection.counts.reconstructed + frames
    wait_until(lambda: connection.counts.reconstructed >= enough)


@contextmanager
def recording_client(folder: Path, code: str = CLIENT) -> Iterator[subprocess.Popen[str]]:
    """A client, or window, that sees wavefronts and records them if it has control."""
    with program("-c", code, str(folder)) as made:
        assert made.stdout is not None
        assert made.stdout.readline() == "sees\n"
        yield made


@pytest.mark.parametrize("how", [SIGKILL, *CRASHES])
def test_clients_notice_the_death_of_the_instrument_and_nothing_is_left(how: signal.Signals, small_toml: Path) -> None:
    for _ in range(KILLS):
        with instrument(small_toml) as running, connected() as connection:
            wait_for_wavefront(connection)
            running.send_signal(how)
            running.wait()
            with own_time() as elapsed_s:
                wait_until(lambda: not connection.is_alive)
                assert elapsed_s() < 3.0
            ended = f"the instrument's process {running.pid} has ended: its light should be off; if it shines, switch"
            assert connection.failure.startswith(ended)
            assert connection.newest is not None  # the last one stays
            wait_until(nothing_is_left)
        with pytest.raises(RunError, match="no instrument runs"):
            reach("test")


def test_a_frozen_instrument_is_shown_and_goes_on(small_toml: Path) -> None:
    with instrument(small_toml) as running, connected() as connection:
        wait_for_wavefront(connection)
        running.send_signal(SIGSTOP)
        wait_until(lambda: "does not answer" in connection.activity.text)
        assert connection.is_alive
        running.send_signal(signal.SIGCONT)
        wait_until(lambda: not connection.activity.text)
        wait_for_more(connection)


def test_clients_see_the_state_of_each_process(small_toml: Path, tmp_path: Path) -> None:
    save_bench(refining := tmp_path / "refining.toml", load_bench(small_toml, ("reconstruction.refine=true",)))
    with instrument(refining) as running, connected() as connection:

        def are(*conditions: str) -> None:
            wanted = list(zip(("instrument", "background estimator"), conditions, strict=False))
            wait_until(lambda: [(each.name, each.condition) for each in connection.processes] == wanted)

        def warning() -> str:
            return "" if connection.status is None else connection.status.warning

        wait_for_wavefront(connection)
        are("alive", "alive")
        assert connection.processes[0].pid == running.pid
        background_estimator = connection.processes[1].pid
        assert not warning()
        os.kill(background_estimator, SIGSTOP)
        are("alive", "frozen")
        assert "layers and corrections was stopped" in warning()
        os.kill(background_estimator, SIGKILL)
        are("alive", "gone")
        assert "layers and corrections has ended" in warning()
        wait_for_more(connection)
        assert connection.newest is not None
        assert connection.newest.quality.faults == Fault.SEARCH
        running.send_signal(SIGSTOP)
        are("frozen")
        running.send_signal(SIGKILL)
        are("gone")


@pytest.mark.parametrize("how", [SIGKILL, *CRASHES, SIGSTOP])
@pytest.mark.parametrize("code", [CLIENT, pytest.param(WINDOW, marks=pytest.mark.long)], ids=["client", "window"])
def test_a_client_that_dies_or_freezes_changes_nothing_but_who_has_control(
    how: signal.Signals, code: str, small_toml: Path, tmp_path: Path
) -> None:
    with instrument(small_toml) as running:
        files = set(runtime_folder().iterdir())
        for turn in range(KILLS):
            folder = tmp_path / f"run{turn}"
            with connected(takes_control=False) as watching, recording_client(folder, code) as client:
                wait_for_wavefront(watching)
                assert watching.controller.startswith("client")
                client.send_signal(how)
                wait_until(lambda: not watching.controller)
                assert (client.poll() is None) is (how == SIGSTOP)
                watching.take_control().result(HANG_S)
                wait_for_more(watching)
                state = watching.recording
                assert state is not None
                assert (state.stage, state.folder, state.gaps) == ("recording", folder, ())
                watching.stop_recording()
                wait_until(lambda: is_finished(watching))
                lines = [json.loads(line) for line in (folder / FRAME_LINES).read_text().splitlines()]
                for before, line in pairwise(lines):  # every frame but those that the camera of a busy computer lost
                    assert line["camera_index"] == before["camera_index"] + 1 + line["lost"]
            assert set(runtime_folder().iterdir()) == files
            assert running.poll() is None


@pytest.mark.long
@pytest.mark.parametrize("how", [SIGKILL, *CRASHES, SIGSTOP])
def test_instrument_of_a_window_that_dies_or_freezes_goes_on(
    how: signal.Signals, small_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))  # not how its user's window looks
    for _ in range(KILLS):
        with program("-c", OWN_WINDOW, str(small_toml)) as window:
            wait_until(lambda: is_taken(NAME))
            with connected(takes_control=False) as watching:
                wait_for_wavefront(watching)
                assert watching.controller.startswith("window")
                window.send_signal(how)
                wait_until(lambda: not watching.controller)
                wait_for_more(watching)
                assert {each.condition for each in watching.processes} == {"alive"}
                watching.take_control().result(HANG_S)
                watching.shut_down().result(HANG_S)
        # The files of its address go one after the other.
        wait_until(lambda: {each.name for each in runtime_folder().iterdir()} == {"instrument.lock", "instrument.log"})


def is_finished(connection: Connection) -> bool:
    return connection.recording is not None and connection.recording.stage == "finished"


def test_ctrl_c_ends_the_instrument_in_order(small_toml: Path, tmp_path: Path) -> None:
    with instrument(small_toml) as running, connected() as connection:
        wait_for_wavefront(connection)
        connection.start_recording(tmp_path / "run").result(HANG_S)
        wait_for_more(connection)
        running.send_signal(signal.SIGINT)
        assert running.wait(HANG_S) == 130
        wait_until(lambda: not connection.is_alive)
        assert connection.failure == "the instrument was shut down"
        assert connection.status is not None
        assert not connection.status.is_light_on
    assert len(Recording(tmp_path / "run")) > 0
    assert not is_taken(NAME)


def test_ctrl_c_amid_the_reference_is_no_warning(
    small_toml: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    save_bench(slow := tmp_path / "slow.toml", load_bench(small_toml, ("camera.exposure_s=0.2",)))
    with instrument(slow) as running, connected() as connection:
        wait_until(lambda: "reference" in connection.activity.text)
        running.send_signal(signal.SIGINT)
        assert running.wait(HANG_S) == 130
        assert running.stdout is not None
        assert running.stdout.read() == ""
    assert capfd.readouterr().err == "svwfs: interrupted: the light is off\n"


def test_measure_attaches(
    small_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(status: int, sentence: str, *arguments: str | Path) -> None:
        assert run(monkeypatch, *arguments) == status
        assert sentence in capsys.readouterr().err

    attached: tuple[str | Path, ...] = ("measure", "--attach", "--frames", "4", "--out")
    fails(2, "--bench cannot go with --attach", *attached, tmp_path / "x", "--bench", "small_demo")
    fails(1, "no instrument runs", *attached, tmp_path / "x")
    fails(2, "add --attach", "measure", "--frames", "4", "--out", tmp_path / "x", "--take-control")
    with instrument(small_toml):
        with connected(takes_control=False) as watching:
            wait_for_wavefront(watching)
            assert run(monkeypatch, *attached, tmp_path / "run") == 0
            said = capsys.readouterr().out
            assert re.search(r"4 frames, \d+ lost by the camera", said)  # of a process that was stopped for 0.2 s
            assert (tmp_path / "run" / "results.nc").exists()
        fails(1, "an instrument named instrument is running already", "serve", "--bench", small_toml)
        with connected() as other:
            wait_until(lambda: other.has_control)
            fails(1, "has control; take control first, with --take-control", *attached, tmp_path / "other")
            assert not (tmp_path / "other").exists()
            fails(2, "holds a recording", *attached, tmp_path / "run", "--take-control")
            assert other.has_control
            assert run(monkeypatch, *attached, tmp_path / "other", "--take-control") == 0
            assert not other.has_control
