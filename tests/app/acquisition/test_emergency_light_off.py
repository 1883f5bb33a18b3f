"""Light switch: it needs no worker, and what was commanded before cannot undo it."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import HANG_S, own_time, wait_until

from app.acquisition.instrument import Instrument
from app.acquisition.running_instrument import Activity
from app.acquisition.worker import Acquisition
from app.measurement.routines import RoutineError
from drivers.interface import LightHeldOff


@pytest.fixture
def camera() -> FakeCamera:
    return FakeCamera()


@pytest.fixture
def acquisition(camera: FakeCamera) -> Iterator[Acquisition]:
    acquisition = Acquisition(BENCH, opener(camera))
    acquisition.start()
    acquisition.submit(_turn_on).result(HANG_S)
    yield acquisition
    acquisition.close()


def _turn_on(instrument: Instrument) -> None:
    instrument.devices.light.set_on(True)


def test_light_goes_off_within_its_time_while_the_worker_is_busy(acquisition: Acquisition, camera: FakeCamera) -> None:
    release = threading.Event()
    busy = acquisition.submit(lambda _: release.wait())
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
    acquisition.submit(lambda _: release.wait())
    before = acquisition.submit(_turn_on)
    acquisition.switch_light_off().result(HANG_S)
    after = acquisition.submit(_turn_on)
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
        acquisition.submit(_turn_on).result(HANG_S)
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
        camera.light.shines, camera.light.off_reason = False, "the light went off"
        return go_on(*arguments, **named)

    acquisition.submit(lambda instrument: instrument.devices.stage.set_sample_in(True)).result(HANG_S)
    release = threading.Event()
    acquisition.submit(lambda _: release.wait())
    reference = acquisition.submit(Instrument.take_reference, 2)
    next_command = acquisition.submit(_turn_on)
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
    acquisition.submit(_turn_on).result(HANG_S)
    assert camera.light.shines


def test_closing_turns_the_light_off_before_the_worker_ends(acquisition: Acquisition, camera: FakeCamera) -> None:
    release = threading.Event()
    acquisition.submit(lambda _: release.wait())
    acquisition.begin_close()
    wait_until(lambda: not camera.light.shines)
    assert acquisition.is_alive
    release.set()
    acquisition.close()
    assert camera.light.log.lightings == 1
