"""The light and its guardian: whatever dies or freezes, the light goes off.

The instrument is a process with the worker, a DCAM camera and a DC4100, whose stand-in is in this process, at a
pseudo-terminal. `SVWFS_KILLS=100` repeats each death; `SVWFS_TIMES=FILE` notes how long the light stayed on.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.command_line import run
from support.dcam_tools import built
from support.light_contract import LightContract
from support.paths import FOREIGN_FRAMES
from support.patience import wait_until
from support.wires.dc4100 import DC4100Wire
from support.wires.pseudo_terminal import PtyServer

from app.acquisition.guarded_light import GuardedLight
from drivers.errors import BadValue, DeviceError, Disconnected
from drivers.interface import LightSource
from drivers.serial_lights import DC4100Settings

KILLS = int(os.environ.get("SVWFS_KILLS", "1"))
TIMES = os.environ.get("SVWFS_TIMES", "")
GONE = "the guardian of the light has ended; the light was switched off: open the bench again"

INSTRUMENT = """
import sys, time
from pathlib import Path
from support.wires.dcam.stand_in import StandIn
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench

bench = load_bench(sys.argv[1])
StandIn(Path(bench.camera.library)).reset(1.0)
acquisition = Acquisition(bench)
acquisition.start()
for step in start_up(acquisition, frames=3):
    step.result()
print("lit", flush=True)
while acquisition.is_alive:
    time.sleep(0.01)
sys.exit(acquisition.failure)
"""


HOLDER = """
import sys, time
from app.acquisition.guarded_light import GuardedLight
from app.acquisition.place import taken_place
from drivers.serial_lights import DC4100Settings

with taken_place() as place:
    place.announce()
    light = GuardedLight(DC4100Settings(port=sys.argv[1]))
    light.keep_alive(1000)  # as before long work
    light.set_on(True)
    print("holds", flush=True)
    sys.stdin.readline()
    begin_s = time.monotonic()
    sum(range(10**6))
    sum(range(int(3.0 / (time.monotonic() - begin_s)) * 10**6))  # no other thread runs meanwhile
    print("has computed", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def lamp() -> DC4100Wire:
    return DC4100Wire()


@pytest.fixture
def port(lamp: DC4100Wire) -> Iterator[PtyServer]:
    with PtyServer(lamp) as server:
        yield server


@pytest.fixture
def reopen(port: PtyServer) -> Callable[[], LightSource]:
    return lambda: GuardedLight(DC4100Settings(port=port.port))


@pytest.fixture
def light(reopen: Callable[[], LightSource]) -> Iterator[LightSource]:
    with reopen() as light:
        yield light


class TestContract(LightContract):
    """A guarded light is a light."""


def children(pid: int) -> set[int]:
    """The processes that all threads of a process have started, and that live."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    found = {int(child) for task in tasks for child in (task / "children").read_text().split()}
    return {child for child in found if not is_gone(child)}


def is_gone(pid: int) -> bool:
    """True if a process has ended, also if its parent has not noticed yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def bench_toml(port: str, folder: Path) -> Path:
    path = folder / "bench.toml"
    path.write_text(
        (FOREIGN_FRAMES / "bench.toml").read_text()
        + f"""
[camera]
driver = "dcam"
library = "{built()}"
exposure_s = 0.02

[light]
driver = "thorlabs_dc4100"
port = "{port}"
current_a = 0.1
"""
    )
    return path


@contextmanager
def lit_instrument(bench: Path, lamp: DC4100Wire) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(  # noqa: S603 - this interpreter
        [sys.executable, "-c", INSTRUMENT, str(bench)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGQUIT, signal.SIG_DFL),  # noqa: PLW1509 - jobs of a shell ignore it
    ) as program:
        try:
            assert program.stdout is not None
            assert program.stderr is not None
            assert program.stdout.readline() == "lit\n", program.stderr.read()
            assert lamp.is_lit
            yield program
        finally:
            program.kill()


def note_time(what: str, number: signal.Signals, seconds: float) -> None:
    if TIMES:
        with Path(TIMES).open("a") as file:
            file.write(json.dumps([what, number.name, seconds]) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["instrument", "guardian", "all of the terminal"])
@pytest.mark.parametrize(
    "number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP, signal.SIGSTOP]
)
def test_light_goes_off_whatever_dies_or_freezes(
    port: PtyServer, lamp: DC4100Wire, tmp_path: Path, victim: str, number: signal.Signals
) -> None:
    bench = bench_toml(port.port, tmp_path)
    for _ in range(KILLS):
        with lit_instrument(bench, lamp) as program:
            (guardian,) = children(program.pid)
            started_s = time.monotonic()
            if victim == "all of the terminal":
                os.killpg(program.pid, number)
            else:
                os.kill(guardian if victim == "guardian" else program.pid, number)
            wait_until(lambda: not lamp.is_lit)
            note_time(victim, number, time.monotonic() - started_s)
            if victim != "guardian":
                program.kill()
            _, errors = program.communicate()
            wait_until(lambda: is_gone(guardian))  # noqa: B023 - called here
            assert not lamp.is_lit
            if victim == "guardian":
                assert GONE in errors
                assert program.returncode == 1
            elif number == signal.SIGSTOP:
                assert "the acquisition gave no sign of life for" in errors


def test_light_without_sign_of_life_goes_off_and_says_why(light: LightSource, lamp: DC4100Wire) -> None:
    light.set_on(True)
    light.keep_alive(0.2)
    wait_until(lambda: not lamp.is_lit)
    assert not light.is_on
    assert light.off_reason == "the light went off because the acquisition gave no sign of life for 0.2 s"
    light.keep_alive(60)
    light.set_on(True)
    assert lamp.is_lit
    assert light.off_reason == ""


def test_light_that_fails_amid_silence_is_closed_with_a_sentence(
    reopen: Callable[[], LightSource], lamp: DC4100Wire, capfd: pytest.CaptureFixture[str]
) -> None:
    with reopen() as light:
        light.set_on(True)
        (guardian,) = children(os.getpid())
        lamp.heads[0].is_on = False  # at its panel
        light.keep_alive(0.2)
        wait_until(lambda: is_gone(guardian))
        with pytest.raises(Disconnected, match="the guardian of the light has ended; the light was switched off"):
            _ = light.current_a
    said = capfd.readouterr().err
    assert "no sign of life for 0.2 s, and the light failed: the DC4100 at" in said
    assert "Traceback" not in said


def test_light_with_signs_of_life_stays_on(light: LightSource, lamp: DC4100Wire) -> None:
    """Each promise replaces the one before."""
    light.set_on(True)
    light.keep_alive(0.2)
    light.keep_alive(60)
    time.sleep(0.5)
    assert lamp.is_lit


def test_calls_renew_the_promise(light: LightSource, lamp: DC4100Wire) -> None:
    """As long as the worker polls a light that answers late, it lives."""
    light.set_on(True)
    light.keep_alive(0.5)
    for _ in range(10):
        time.sleep(0.1)
        assert light.is_on
    wait_until(lambda: not lamp.is_lit)


@pytest.mark.parametrize("start", ["import time; time.sleep(2)", "print('a library says hello')"])
def test_guardian_may_start_slowly_and_say_what_is_no_answer(
    reopen: Callable[[], LightSource], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: str
) -> None:
    """It counts as frozen 1.25 s after its first sign of life, not after its start."""
    (tmp_path / "sitecustomize.py").write_text(start)
    monkeypatch.syspath_prepend(tmp_path)
    with reopen() as light:
        assert "DC4100" in light.name


def test_errors_of_the_light_come_through(light: LightSource, lamp: DC4100Wire, port: PtyServer) -> None:
    with pytest.raises(BadValue, match="outside"):
        light.set_current(99.0)
    assert light.properties()["firmware"] == "1.8.4"
    light.set_on(True)
    lamp.heat_up()
    with pytest.raises(DeviceError, match="too hot"):
        _ = light.is_on
    port.unplug()
    with pytest.raises(Disconnected, match="is gone"):
        _ = light.current_a


def test_light_that_cannot_be_opened_leaves_no_process(port: PtyServer) -> None:
    port.close()
    before = children(os.getpid())
    with pytest.raises(Disconnected, match=port.port):
        GuardedLight(DC4100Settings(port=port.port))
    assert children(os.getpid()) == before


def test_light_that_cannot_be_taken_over_ends_all_calls(port: PtyServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver fails with an error that is none of a device."""

    def fail(_: object) -> None:
        raise OSError("no memory left")

    before = children(os.getpid())
    light = GuardedLight(DC4100Settings(port=port.port))
    light.set_on(True)
    monkeypatch.setattr("app.acquisition.guardian.switch_off", fail)
    os.kill((children(os.getpid()) - before).pop(), signal.SIGKILL)
    for _ in range(2):
        with pytest.raises(Disconnected, match=r"\(no memory left\); the light may still be on"):
            _ = light.is_on
    light.close()


def test_dead_guardian_whose_light_is_gone_says_that_it_may_be_on(port: PtyServer) -> None:
    before = children(os.getpid())
    light = GuardedLight(DC4100Settings(port=port.port))
    light.set_on(True)
    (guardian,) = children(os.getpid()) - before
    port.unplug()
    os.kill(guardian, signal.SIGKILL)
    with pytest.raises(Disconnected, match="may still be on: switch it off by hand"):
        _ = light.is_on
    light.close()


def test_light_off_switches_it_off(
    port: PtyServer,
    lamp: DC4100Wire,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bench = bench_toml(port.port, tmp_path)
    lamp.heads[0].is_on = True
    assert run(monkeypatch, "light-off", "--bench", bench) == 0
    assert not lamp.is_lit
    assert "LED1 is off" in capsys.readouterr().out


@pytest.mark.parametrize(("driver", "status", "words"), [("simulated", 0, "nothing to"), ("manual", 1, "by hand")])
def test_light_off_without_a_light(
    driver: str,
    status: int,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(
        bench_toml("unused", tmp_path).read_text().partition("[light]")[0] + '[light]\ndriver = "manual"\n'
    )
    name = "small_demo" if driver == "simulated" else str(bench)
    assert run(monkeypatch, "light-off", "--bench", name) == status
    assert words in "".join(capsys.readouterr())


@contextmanager
def holder(port: PtyServer) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(  # noqa: S603 - this interpreter
        [sys.executable, "-c", HOLDER, port.port],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "holds\n"
        try:
            yield program
        finally:
            program.kill()


@pytest.mark.slow
@pytest.mark.parametrize("wakes", [False, True])
def test_light_goes_off_if_the_process_freezes_amid_long_work(
    port: PtyServer, lamp: DC4100Wire, *, wakes: bool
) -> None:
    """The worker need not give a sign of life for long, but its process answers the guardian."""
    with holder(port) as program:
        time.sleep(2.0)
        assert lamp.is_lit
        program.send_signal(signal.SIGSTOP)
        wait_until(lambda: not lamp.is_lit)
        if wakes:
            program.send_signal(signal.SIGCONT)
            time.sleep(0.5)
        program.kill()
        _, errors = program.communicate()
    assert errors == "svwfs: the light went off because the acquisition gave no sign of life for 1.5 s\n"


@pytest.mark.slow
def test_light_stays_on_while_one_thread_lets_no_other_run(port: PtyServer, lamp: DC4100Wire) -> None:
    """As a library that compiles, or that holds Python's lock while it computes."""
    with holder(port) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        program.stdin.write("\n")
        program.stdin.flush()
        assert program.stdout.readline() == "has computed\n"
        assert lamp.is_lit


@pytest.mark.slow
def test_guardian_removes_the_address_of_an_instrument_that_was_killed(port: PtyServer, runtime_folder: Path) -> None:
    with holder(port) as program:
        files = next(runtime_folder.iterdir())
        assert (files / "instrument.json").exists()
        program.kill()
    wait_until(lambda: [each.name for each in files.iterdir()] == ["instrument.lock"])
