"""Signals that end the program: the light goes off, and handlers are restored."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable

import pytest
from support.patience import HANG_S
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.pseudo_terminal import PtyServer

from app.errors import ENDING, ended_by

# A command that keeps the light on; it runs as any other, but its terminal closes early.
LIT = """
import sys, time, typer
from dataclasses import replace
from app.cli import main
from app.cli.application import cli
from drivers.serial_lights import thorlabs_dc4100
from drivers.serial_lights import DC4100Settings
from drivers.serial_lights.thorlabs_dc4100 import ThorlabsDC4100

thorlabs_dc4100._DIALECT = replace(thorlabs_dc4100._DIALECT, timeout_s=60.0)

@cli.command()
def shine(port: str) -> None:
    with ThorlabsDC4100(DC4100Settings(port=port)) as light:
        light.set_on(True)
        print("lit", flush=True)
        time.sleep(60)

main()
"""


def lit_program(port: str, prepare: Callable[[], object]) -> subprocess.Popen[str]:
    return subprocess.Popen(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", LIT, "shine", port],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=prepare,  # noqa: PLW1509 - it has one thread
    )


@pytest.mark.posix
@pytest.mark.parametrize("number", ENDING)
def test_signal_switches_the_light_off(number: signal.Signals) -> None:
    device = DC4100Wire()
    with (
        PtyServer(device) as server,
        lit_program(server.port, lambda: signal.signal(number, signal.SIG_DFL)) as program,
    ):
        assert program.stdout is not None
        assert program.stdout.readline() == "lit\n"
        assert device.is_lit
        program.stdout.close()  # the terminal is gone
        program.send_signal(number)
        _, errors = program.communicate(timeout=HANG_S)
        assert not device.is_lit
        assert device.log.lightings == 1
        assert (program.returncode, errors) == (130, "svwfs: interrupted\n")


@pytest.mark.posix
def test_hangup_ignored_by_nohup_ends_nothing() -> None:
    device = DC4100Wire()
    ignoring = lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)  # noqa: E731 - as nohup does
    with PtyServer(device) as server, lit_program(server.port, ignoring) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "lit\n"
        program.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            program.wait(0.3)
        assert device.is_lit
        program.terminate()
        program.communicate(timeout=HANG_S)
        assert not device.is_lit


@pytest.mark.usefixtures("default_signals")
def test_handlers_are_restored() -> None:
    came: list[int] = []
    before = [signal.getsignal(number) for number in ENDING]
    with ended_by(lambda number, _frame: came.append(number)):
        for number in ENDING:
            signal.raise_signal(number)
    assert came == list(ENDING)
    assert [signal.getsignal(number) for number in ENDING] == before
