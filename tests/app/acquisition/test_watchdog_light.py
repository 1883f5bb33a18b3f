"""The light in its watchdog: calls, errors, signs of life, and ends of the watchdog."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.gui_bench import BENCH, FakeCamera
from support.light_contract import LightContract
from support.patience import HANG_S, own_time, wait_until
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.pseudo_terminal import PtyServer
from support.stand_ins.serial import LineFault
from support.watchdog_instrument import children, is_gone

from app.acquisition.instrument import Instrument, ProcessState
from app.acquisition.watchdog import switch_off
from app.acquisition.watchdog_light import WatchdogLight
from app.progress import run_in_thread
from drivers.errors import BadValue, Busy, DeviceError, Disconnected, WrongState
from drivers.interface import Devices, LightSource
from drivers.serial_lights import DC4100Settings
from reconstruction.runtime.child_process import Condition


@pytest.fixture
def reopen(lamp_port: PtyServer) -> Callable[[], LightSource]:
    return lambda: WatchdogLight(DC4100Settings(port=lamp_port.port))


@pytest.fixture
def light(reopen: Callable[[], LightSource]) -> Iterator[LightSource]:
    with reopen() as light:
        yield light


class TestContract(LightContract):
    """A guarded light is a light."""


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


def test_light_with_signs_of_life_stays_on(light: LightSource, lamp: DC4100Wire) -> None:
    """Each promise replaces the one before."""

    def has_promised() -> bool:
        """False if this process or the watchdog was stopped too long amid the promises."""
        light.set_on(True)
        light.keep_alive(0.2)
        light.keep_alive(60)
        return light.is_on

    wait_until(has_promised)
    lightings = lamp.log.lightings
    time.sleep(0.5)
    assert lamp.is_lit
    assert lamp.log.lightings == lightings


def test_calls_renew_the_promise(light: LightSource, lamp: DC4100Wire) -> None:
    """As long as the worker polls a light that answers late, it lives."""
    light.set_on(True)
    light.keep_alive(0.5)
    for _ in range(10):
        time.sleep(0.1)
        assert light.is_on
    called_s = time.monotonic()
    wait_until(lambda: not lamp.log.is_lit)
    assert lamp.log.off_s - called_s > 0.4


@pytest.mark.parametrize("start", ["import time; time.sleep(2)", "print('a library says hello')"])
def test_watchdog_may_start_slowly_and_say_what_is_no_answer(
    reopen: Callable[[], LightSource], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: str
) -> None:
    """It counts as frozen 1.25 s after its first sign of life, not after its start."""
    (tmp_path / "sitecustomize.py").write_text(start)
    monkeypatch.syspath_prepend(tmp_path)
    with reopen() as light:
        assert "DC4100" in light.name


def test_watchdog_ends_if_its_pipe_closes_while_it_asks_for_its_parent(
    lamp_port: PtyServer, lamp: DC4100Wire, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows, where the number of the parent stays after its death."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, time\nparent = os.getppid()\nos.getppid = lambda: time.sleep(1) or parent\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    light = WatchdogLight(DC4100Settings(port=lamp_port.port))
    light.set_on(True)
    assert light.watchdog.stdin is not None
    time.sleep(0.5)  # now it asks
    light.watchdog.stdin.close()
    assert light.watchdog.wait(HANG_S) == 0
    assert not lamp.is_lit
    with pytest.raises(WrongState, match="closed"):
        light.close()


def test_errors_of_the_light_come_through(light: LightSource, lamp: DC4100Wire, lamp_port: PtyServer) -> None:
    with pytest.raises(BadValue, match="outside"):
        light.set_current(99.0)
    assert light.properties()["firmware"] == "1.8.4"
    light.set_on(True)
    lamp.heat_up()
    with pytest.raises(DeviceError, match="too hot"):
        _ = light.is_on
    lamp_port.unplug()
    with pytest.raises(Disconnected, match="is gone"):
        _ = light.current_a


@pytest.mark.posix
def test_light_that_cannot_be_opened_leaves_no_process(lamp_port: PtyServer) -> None:
    lamp_port.close()
    before = children(os.getpid())
    with pytest.raises(Disconnected, match=lamp_port.port):
        WatchdogLight(DC4100Settings(port=lamp_port.port))
    assert children(os.getpid()) == before


@pytest.mark.posix
def test_dead_watchdog_whose_light_is_gone_says_that_it_may_be_on(lamp_port: PtyServer) -> None:
    before = children(os.getpid())
    light = WatchdogLight(DC4100Settings(port=lamp_port.port))
    light.set_on(True)
    (watchdog,) = children(os.getpid()) - before
    lamp_port.unplug()
    os.kill(watchdog, signal.SIGKILL)
    with pytest.raises(Disconnected, match="may still be on: switch it off by hand"):
        _ = light.is_on
    light.close()


@pytest.mark.posix
@pytest.mark.slow
def test_light_whose_call_hangs_is_taken_back(
    reopen: Callable[[], LightSource], lamp: DC4100Wire, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A call that hangs in the kernel lets the other threads of the watchdog run."""
    os.mkfifo(nobody_writes := tmp_path / "nobody_writes")
    replace_method("properties", f"open({str(nobody_writes)!r})", tmp_path, monkeypatch)
    with reopen() as light:
        light.set_on(True)
        with pytest.raises(Disconnected, match="the watchdog of the light has ended; the light was switched off"):
            light.properties()
        assert not lamp.is_lit


@pytest.mark.posix
@pytest.mark.slow
def test_watchdog_whose_call_hangs_ends_if_the_instrument_was_killed(
    lamp_port: PtyServer, lamp: DC4100Wire, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(nobody_writes := tmp_path / "nobody_writes")
    called = tmp_path / "called"
    replace_method(
        "properties", f"open({str(called)!r}, 'w').close() or open({str(nobody_writes)!r})", tmp_path, monkeypatch
    )
    code = (
        "import sys; from app.acquisition.watchdog_light import WatchdogLight;"
        " from drivers.serial_lights import DC4100Settings; light = WatchdogLight(DC4100Settings(port=sys.argv[1]));"
        " light.set_on(True); print('lit', flush=True); light.properties()"
    )
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", code, lamp_port.port]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=paths) as instrument:  # noqa: S603 - this interpreter
        assert instrument.stdout is not None
        assert instrument.stdout.readline() == b"lit\n"
        (watchdog,) = children(instrument.pid)
        wait_until(called.exists)
        instrument.kill()
    settings = {"driver": "thorlabs_dc4100", "port": lamp_port.port}
    with pytest.raises(Busy):
        switch_off(settings)
    assert lamp.is_lit
    wait_until(lambda: is_gone(watchdog))
    switch_off(settings)
    assert not lamp.is_lit


@pytest.mark.slow
def test_call_that_takes_its_time_is_no_hang(
    reopen: Callable[[], LightSource], lamp: DC4100Wire, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A DC2200 that is silent fails after 8 s."""
    replace_method("properties", "__import__('time').sleep(8.5) or {}", tmp_path, monkeypatch)
    with reopen() as light:
        light.set_on(True)
        began_s = time.monotonic()
        with own_time() as elapsed_s:
            asked, asking = run_in_thread(light.properties, "properties")
            wait_until(lambda: light.is_silent)
            assert time.monotonic() - began_s > 1.5
            assert elapsed_s() < 4
        assert not asked.done()
        asking.join()
        assert not light.is_silent
        assert lamp.is_lit


def replace_method(name: str, expression: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let watchdogs evaluate an expression in place of a method of their light."""
    (folder / "sitecustomize.py").write_text(
        "from drivers.serial_lights.thorlabs_dc4100 import ThorlabsDC4100\n"
        f"ThorlabsDC4100.{name} = lambda _: {expression}\n"
    )
    monkeypatch.syspath_prepend(folder)


@pytest.mark.posix
def test_death_of_a_watchdog_whose_pipe_stays_open_is_noticed(
    reopen: Callable[[], LightSource], lamp: DC4100Wire, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that a vendor's library has forked holds it."""
    (tmp_path / "sitecustomize.py").write_text(
        f"import os, time\nif forked := os.fork():\n    open({str(tmp_path / 'pid')!r}, 'w').write(str(forked))\n"
        "else:\n    time.sleep(60)\n    os._exit(0)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    before = children(os.getpid())
    with reopen() as light:
        light.set_on(True)
        (watchdog,) = children(os.getpid()) - before
        forked = int((tmp_path / "pid").read_text())
        os.kill(watchdog, signal.SIGKILL)
        with pytest.raises(Disconnected, match="has ended; the light was switched off"):
            wait_until(lambda: not light.is_on)
        assert not lamp.is_lit
        assert not is_gone(forked)
        os.kill(forked, signal.SIGKILL)


def test_light_that_is_closed_as_its_watchdog_dies_is_known_to_be_off(
    lamp_port: PtyServer, lamp: DC4100Wire, capfd: pytest.CaptureFixture[str]
) -> None:
    light = WatchdogLight(DC4100Settings(port=lamp_port.port))
    light.set_on(True)
    light.watchdog.kill()
    light.close()
    assert not lamp.is_lit
    said = capfd.readouterr().err
    assert "the light was switched off" in said
    assert "may still be on" not in said


@pytest.mark.posix
def test_late_answer_to_a_call_that_ctrl_c_ended_is_passed_over(light: WatchdogLight, lamp: DC4100Wire) -> None:
    light.set_current(0.25)
    lamp.faults.append(LineFault("late", 0.3))
    watchdog, main = light.watchdog, threading.main_thread().ident
    assert main is not None

    def press_ctrl_c() -> None:
        wait_until(lambda: not lamp.faults)  # the call has reached the lamp
        watchdog.send_signal(signal.SIGSTOP)  # however late this thread is, the answer comes later
        number = light._watchdog._number
        signal.pthread_kill(main, signal.SIGINT)
        wait_until(lambda: light._watchdog._number > number)  # the next call, which switches the light off
        watchdog.send_signal(signal.SIGCONT)

    _, pressing = run_in_thread(press_ctrl_c, "Ctrl-C")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # even if the tests ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            _ = light.current_range_a
    finally:
        signal.signal(signal.SIGINT, before)
    pressing.join()
    assert light.current_a == 0.25
    assert not light.is_on
    assert light.properties()["firmware"] == "1.8.4"


def test_pipe_of_the_watchdog_is_no_standard_input(
    reopen: Callable[[], LightSource], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NumPy asks about the standard input; on Windows it would wait for the thread that reads the pipe."""
    is_pipe = "__import__('stat').S_ISFIFO(__import__('os').fstat(0).st_mode)"
    replace_method("properties", f"{{'is pipe': {is_pipe}}}", tmp_path, monkeypatch)
    with reopen() as light:
        assert light.properties() == {"is pipe": False}


@pytest.mark.posix
def test_process_is_alive_frozen_or_gone() -> None:
    with subprocess.Popen(["sleep", "600"]) as process:  # noqa: S607 - of every system

        def has(condition: Condition) -> bool:
            return ProcessState.of("background estimator", process) == ProcessState(
                "background estimator", process.pid, condition
            )

        assert has("alive")
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: has("frozen"))
        process.send_signal(signal.SIGCONT)
        wait_until(lambda: has("alive"))
        process.kill()
        wait_until(lambda: has("gone"))


def test_instrument_knows_the_watchdog_of_its_light(light: WatchdogLight) -> None:
    camera = FakeCamera()
    instrument = Instrument(Devices(camera, light, camera.stage), BENCH)
    (watchdog,) = instrument.processes()
    assert watchdog == ProcessState("watchdog", light.watchdog.pid, "alive")
    light.watchdog.kill()
    wait_until(lambda: instrument.processes()[0].condition == "gone")
