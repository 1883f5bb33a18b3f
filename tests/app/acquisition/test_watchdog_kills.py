"""The light goes off whatever dies or freezes; `SVWFS_KILLS=100` repeats each death."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.patience import HANG_S, wait_until
from support.posix import SIGHUP, SIGKILL, SIGQUIT, SIGSTOP
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.pseudo_terminal import PtyServer
from support.watchdog_instrument import bench_toml, children, is_gone

pytestmark = [pytest.mark.slow, pytest.mark.posix]

KILLS = int(os.environ.get("SVWFS_KILLS", "1"))
GONE = "the watchdog of the light has ended; the light was switched off: open the bench again"

HOLDER = """
import sys, time
from app.acquisition.watchdog_light import WatchdogLight
from drivers.serial_lights import DC4100Settings

light = WatchdogLight(DC4100Settings(port=sys.argv[1]))
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


INSTRUMENT = """
import sys, time
from pathlib import Path
from support.stand_ins.dcam.stand_in import StandIn
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


def _hear_all() -> None:
    """Die of what jobs of a shell and of `nohup` ignore."""
    for number in (SIGQUIT, SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@contextmanager
def lit_instrument(bench: Path, lamp: DC4100Wire) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(  # noqa: S603 - this interpreter
        [sys.executable, "-c", INSTRUMENT, str(bench)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        start_new_session=True,
        preexec_fn=_hear_all,  # noqa: PLW1509 - no thread is needed in it
    ) as program:
        try:
            assert program.stdout is not None
            assert program.stderr is not None
            assert program.stdout.readline() == "lit\n", program.stderr.read()
            assert lamp.is_lit
            yield program
        finally:
            program.kill()


@pytest.mark.parametrize("victim", ["instrument", "watchdog", "all of the terminal"])
@pytest.mark.parametrize("number", [SIGKILL, signal.SIGSEGV, SIGQUIT, signal.SIGTERM, SIGHUP, SIGSTOP])
def test_light_goes_off_whatever_dies_or_freezes(
    lamp_port: PtyServer, lamp: DC4100Wire, tmp_path: Path, victim: str, number: signal.Signals
) -> None:
    bench = bench_toml(lamp_port.port, tmp_path)
    for _ in range(KILLS):
        with lit_instrument(bench, lamp) as program:
            (watchdog,) = children(program.pid)
            lightings = lamp.log.lightings
            if victim == "all of the terminal":
                os.killpg(program.pid, number)
            else:
                os.kill(watchdog if victim == "watchdog" else program.pid, number)
            wait_until(lambda: not lamp.log.is_lit)
            if victim != "watchdog":
                program.kill()
            _, errors = program.communicate(timeout=HANG_S)
            wait_until(lambda: is_gone(watchdog))  # noqa: B023 - called here
            assert not lamp.is_lit
            assert lamp.log.lightings == lightings  # it was not lit again
            if victim == "watchdog":
                assert GONE in errors
                assert program.returncode == 1
            elif number == SIGSTOP:
                assert "the acquisition gave no sign of life for" in errors


@contextmanager
def holder(lamp_port: PtyServer) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(  # noqa: S603 - this interpreter
        [sys.executable, "-c", HOLDER, lamp_port.port],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "holds\n"
        (watchdog,) = children(program.pid)
        try:
            yield program
        finally:
            program.kill()
            wait_until(lambda: is_gone(watchdog))  # it holds the terminal, whose number the next test may get again


@pytest.mark.parametrize("wakes", [False, True])
def test_light_goes_off_if_the_process_freezes_amid_long_work(
    lamp_port: PtyServer, lamp: DC4100Wire, *, wakes: bool
) -> None:
    """The worker need not give a sign of life for long, but its process answers the watchdog."""
    with holder(lamp_port) as program:
        time.sleep(2.0)
        assert lamp.is_lit
        lightings = lamp.log.lightings
        program.send_signal(SIGSTOP)
        wait_until(lambda: not lamp.is_lit)
        if wakes:
            program.send_signal(signal.SIGCONT)
            time.sleep(0.5)
        program.kill()
        _, errors = program.communicate(timeout=HANG_S)
    assert lamp.log.lightings == lightings
    assert errors == "svwfs: the light went off because the acquisition gave no sign of life for 1.5 s\n"


def test_light_stays_on_while_one_thread_lets_no_other_run(lamp_port: PtyServer, lamp: DC4100Wire) -> None:
    """As a library that compiles, or that holds Python's lock while it computes."""
    with holder(lamp_port) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        program.stdin.write("\n")
        program.stdin.flush()
        assert program.stdout.readline() == "has computed\n"
        assert lamp.is_lit
