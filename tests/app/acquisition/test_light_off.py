"""Switching the light off: it waits for no worker, and no command from before lights the light again."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import HANG_S, own_time, wait_until
from support.served import connected, served

from app.acquisition.instrument import Activity, Instrument, Status
from app.acquisition.remote.messages import Command
from app.acquisition.remote.server import Server
from app.acquisition.worker import Acquisition
from app.measurement.routines import RoutineError
from drivers.interface import LightHeldOff, WrongState


@pytest.fixture
def camera() -> FakeCamera:
    return FakeCamera()


@pytest.fixture
def acquisition(camera: FakeCamera) -> Iterator[Acquisition]:
    acquisition = Acquisition(BENCH, opener(camera))
    acquisition.start()
    acquisition.commands.submit(_turn_on).result(HANG_S)
    yield acquisition
    acquisition.close()


def _turn_on(instrument: Instrument) -> None:
    instrument.devices.light.set_on(True)


def test_light_goes_off_within_its_time_while_the_worker_is_busy(acquisition: Acquisition, camera: FakeCamera) -> None:
    release = threading.Event()
    busy = acquisition.commands.submit(lambda _: release.wait())
    with own_time() as elapsed_s:
        acquisition.switch_light_off().result(HANG_S)
        assert elapsed_s() < 0.3
    assert not camera.light.shines
    wait_until(lambda: acquisition.status is not None and not acquisition.status.is_light_on)
    assert not busy.done()
    release.set()


def test_light_that_does_not_answer_is_shown_while_the_worker_waits(
    acquisition: Acquisition, camera: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert acquisition.activity.text == ""
    monkeypatch.setattr(type(camera.light), "is_silent", True)
    assert acquisition.activity == Activity("the light does not answer", may_cancel=False)


def test_commands_sent_before_cannot_switch_on_again(acquisition: Acquisition, camera: FakeCamera) -> None:
    release = threading.Event()
    acquisition.commands.submit(lambda _: release.wait())
    before = acquisition.set_light_on(True)
    acquisition.switch_light_off().result(HANG_S)
    after = acquisition.set_light_on(True)
    release.set()
    with pytest.raises(LightHeldOff, match="switched off meanwhile"):
        before.result(HANG_S)
    after.result(HANG_S)
    assert camera.light.shines
    assert camera.light.log.lightings == 2  # the first by the fixture


def test_light_is_not_lit_if_switched_off_while_it_lights_up(acquisition: Acquisition, camera: FakeCamera) -> None:
    acquisition.switch_light_off().result(HANG_S)
    steps: list[float] = []

    def sleep(seconds: float) -> None:
        steps.append(seconds)
        if len(steps) == 2:
            switching.append(acquisition.switch_light_off())

    switching = list[object]()
    camera.light._sleep = sleep
    camera.light._current = 1.0
    with pytest.raises(LightHeldOff):
        acquisition.commands.submit(_turn_on).result(HANG_S)
    assert len(steps) == 2
    assert camera.light.current_a == 1.0  # as set before
    wait_until(lambda: not camera.light.shines)


@pytest.mark.parametrize("moment", ["amid the frames", "before the light is lit"])
def test_light_that_goes_off_in_a_routine_is_lit_by_no_command_sent_before(
    acquisition: Acquisition, camera: FakeCamera, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    device, method = (camera, "_read") if moment == "amid the frames" else (camera.stage, "_set_sample_in")
    go_on = getattr(device, method)

    def freeze(*arguments: object, **named: object) -> object:
        camera.light.shines = False
        camera.light._note_went_off("the light went off")
        return go_on(*arguments, **named)

    acquisition.commands.submit(lambda instrument: instrument.devices.stage.set_sample_in(True)).result(HANG_S)
    release = threading.Event()
    acquisition.commands.submit(lambda _: release.wait())
    reference = acquisition.take_reference(2)
    next_command = acquisition.commands.submit(_turn_on)
    monkeypatch.setattr(device, method, freeze)
    release.set()
    with pytest.raises((RoutineError, LightHeldOff), match=r"the light went off: switch it on \(L\) and repeat"):
        reference.result(HANG_S)
    with pytest.raises(LightHeldOff):
        next_command.result(HANG_S)
    assert not camera.light.shines
    assert camera.light.log.lightings == 1
    assert acquisition.status is not None
    assert acquisition.status.reference.doubt.startswith("no reference yet")
    acquisition.commands.submit(_turn_on).result(HANG_S)
    assert camera.light.shines


def test_status_does_not_say_on_when_the_light_went_off_meanwhile(
    acquisition: Acquisition, monkeypatch: pytest.MonkeyPatch
) -> None:
    query, queried = Instrument.status, list[Status]()

    def switch_off_meanwhile(instrument: Instrument) -> Status:
        queried.append(query(instrument))
        if len(queried) == 1:
            acquisition.switch_light_off().result(HANG_S)
            assert acquisition.status == replace(queried[0], is_light_on=False)
        return queried[-1]

    monkeypatch.setattr(Instrument, "status", switch_off_meanwhile)
    acquisition.set_sample_in(False).result(HANG_S)
    assert queried[0].is_light_on
    assert acquisition.status is not None
    assert not acquisition.status.is_light_on


def test_light_is_not_lit_if_switched_off_while_the_devices_are_opened(camera: FakeCamera) -> None:
    acquisition = Acquisition(BENCH, opener(camera))
    lighting = acquisition.set_light_on(True)
    acquisition.switch_light_off().result(HANG_S)
    acquisition.start()
    with pytest.raises(LightHeldOff):
        lighting.result(HANG_S)
    acquisition.set_light_on(True).result(HANG_S)
    assert camera.light.log.lightings == 1
    acquisition.close()


@pytest.mark.usefixtures("runtime_folder")
@pytest.mark.parametrize("order", ["on, off", "off, on"])
def test_of_the_commands_that_a_server_reads_together_none_lights_before_off(
    camera: FakeCamera, monkeypatch: pytest.MonkeyPatch, order: str
) -> None:
    """As those that wait for an instrument that was stopped; its worker could begin one before the next is heard."""
    kept, arrived, execute = list[tuple[bytes, object]](), Server._arrived, Server._execute

    def both_commands(server: Server) -> Iterator[tuple[bytes, object]]:
        kept.extend(arrived(server))
        if sum(isinstance(message, Command) for _, message in kept) == 2:
            yield from kept
            kept.clear()

    def execute_slowly(server: Server, identity: bytes, command: Command) -> None:
        execute(server, identity, command)
        time.sleep(0.2)

    with served(camera, begin=lambda _: None), connected("first") as first, connected("second") as second:
        wait_until(lambda: first.status is not None)
        monkeypatch.setattr(Server, "_execute", execute_slowly)
        monkeypatch.setattr(Server, "_arrived", both_commands)
        if order == "on, off":
            lighting = first.set_light_on(True)
            wait_until(lambda: any(isinstance(message, Command) for _, message in kept))
            second.switch_light_off().result(HANG_S)  # a client that only watches may
            with pytest.raises(WrongState, match="switched off meanwhile"):
                lighting.result(HANG_S)
            assert camera.light.log.lightings == 0
        else:
            darkening = second.switch_light_off()
            wait_until(lambda: any(isinstance(message, Command) for _, message in kept))
            first.set_light_on(True).result(HANG_S)
            darkening.result(HANG_S)
            assert camera.light.shines


def test_closing_turns_the_light_off_before_the_worker_ends(acquisition: Acquisition, camera: FakeCamera) -> None:
    release = threading.Event()
    acquisition.commands.submit(lambda _: release.wait())
    acquisition.begin_close()
    wait_until(lambda: not camera.light.shines)
    assert acquisition.is_alive
    release.set()
    acquisition.close()
    assert camera.light.log.lightings == 1
