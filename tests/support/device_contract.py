"""What every camera, light and stage must do, simulated or real over its stand-in.

Subclass and give the fixtures. `CameraContract` needs `camera`, open and stopped, and `reopen`, which opens the same
one again; `CameraFaultContract` also `faults`, the hand at its cable. Likewise for lights, and for a stage without
faults. The checks themselves are `drivers/*_contract.py`: `svwfs devices --check` runs the same on a connected device.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Protocol

import pytest

from drivers.contract import camera as camera_contract
from drivers.contract import light as light_contract
from drivers.contract import stage as stage_contract
from drivers.contract.camera import CAMERA_CHECKS
from drivers.contract.light import LIGHT_CHECKS
from drivers.contract.stage import STAGE_CHECKS
from drivers.interface import (
    Camera,
    CameraState,
    DeviceError,
    DeviceTimeout,
    Disconnected,
    Frame,
    FrameLost,
    LightSource,
    Stage,
)
from support.patience import HANG_S, own_time

AT_ONCE_S = 2.0  # within which a pulled plug must be told
BY_HAND = "the light may still be on: switch it off by hand"
_PAUSE_S = 0.03
_SLICE_S = 0.1


class CameraFaults(Protocol):
    """What can happen to a camera; each takes effect at once, also from another thread."""

    def unplug(self) -> None:
        """Pull the plug."""

    def plug_in(self) -> None:
        """Put it back, so that the camera can be opened anew."""

    def stall(self) -> None:
        """No further frame comes."""

    def lose_frames(self, count: int) -> None:
        """The next `count` frames never arrive whole."""

    def refuse_next(self) -> None:
        """The next setting is refused."""


class LightFaults(Protocol):
    """What can happen to a light."""

    @property
    def shines(self) -> bool:
        """Whether light comes out, whatever the driver believes."""

    def unplug(self) -> None:
        """Pull the plug."""

    def plug_in(self) -> None:
        """Put it back, so that the light can be opened anew."""

    def refuse_next(self) -> None:
        """The next setting is refused."""

    def fail_next(self) -> None:
        """The next exchange fails in a way that a second one may survive: garbage, or no answer in time."""


class CameraContract:
    @pytest.mark.parametrize("check", CAMERA_CHECKS, ids=lambda check: check.__name__)
    def test_contract(self, camera: Camera, check: Callable[[Camera], None]) -> None:
        check(camera)
        _expect_state(camera, "stopped")

    def test_closes_for_good(self, camera: Camera) -> None:
        camera_contract.check_closes_for_good(camera)

    def test_closed_in_a_pause_it_stays_closed(self, camera: Camera) -> None:
        camera.start()
        with camera.paused():
            camera.close()
        _expect_state(camera, "closed")

    def test_opens_anew(self, camera: Camera, reopen: Callable[[], Camera]) -> None:
        camera_contract.check_opens_anew(camera, reopen)


class CameraFaultContract(CameraContract):
    def test_unplugged_at_rest_every_call_says_so_and_it_closes(self, camera: Camera, faults: CameraFaults) -> None:
        faults.unplug()
        _expect_within(Disconnected, camera.start)
        _expect_state(camera, "lost")
        for what, call in camera_contract.calls_of(camera).items():
            with pytest.raises(Disconnected):
                pytest.fail(f"{what} returned {call()}")
        assert camera.name
        camera.close()
        camera.close()
        _expect_state(camera, "closed")

    def test_unplugged_in_the_middle_of_a_frame(self, camera: Camera, faults: CameraFaults) -> None:
        camera.set_exposure(min(1.0, camera.capabilities.exposure_range_s.maximum))
        camera.start()
        with own_time() as elapsed_s:
            pulled_s = _after_a_pause(faults.unplug, elapsed_s)
            with pytest.raises(Disconnected):
                _read(camera)
            assert elapsed_s() - pulled_s() < AT_ONCE_S
        _expect_state(camera, "lost")
        camera.close()

    def test_unplugged_in_a_pause_it_is_lost(self, camera: Camera, faults: CameraFaults) -> None:
        def lose() -> None:
            with camera.paused():
                faults.unplug()
                _repeat(lambda: camera.exposure_s)

        camera.start()
        with pytest.raises(Disconnected):
            lose()
        _expect_state(camera, "lost")

    def test_unplugged_in_the_middle_of_a_command(self, camera: Camera, faults: CameraFaults) -> None:
        allowed = camera.capabilities.exposure_range_s
        with own_time() as elapsed_s:
            pulled_s = _after_a_pause(faults.unplug, elapsed_s)
            with pytest.raises(Disconnected):
                _repeat(lambda: camera.set_exposure(allowed.minimum))
            assert elapsed_s() - pulled_s() < AT_ONCE_S
        camera.close()

    def test_plugged_in_again_it_can_be_opened_anew(
        self, camera: Camera, reopen: Callable[[], Camera], faults: CameraFaults
    ) -> None:
        camera.start()
        faults.unplug()
        with pytest.raises(Disconnected):
            _read(camera)
        faults.plug_in()
        with pytest.raises(Disconnected):  # nobody knows what it forgot meanwhile
            camera.stop()
        camera.close()
        with reopen() as again:
            again.start()
            assert _whole_frame(again).index == 0

    def test_stalled_it_times_out_and_can_be_stopped(self, camera: Camera, faults: CameraFaults) -> None:
        camera.start()
        assert _whole_frame(camera).index == 0
        faults.stall()
        with pytest.raises(DeviceTimeout):
            _read(camera)
        _expect_state(camera, "running")
        camera.stop()
        _expect_state(camera, "stopped")

    def test_lost_frames_show_as_a_gap(self, camera: Camera, faults: CameraFaults) -> None:
        allowed = camera.capabilities.exposure_range_s
        camera.set_exposure(min(max(0.05, allowed.minimum), allowed.maximum))
        camera.start()
        assert _whole_frame(camera).index == 0
        last = 0
        for _ in range(10):
            faults.lose_frames(3)
            indexes = [last, *(_whole_frame(camera).index for _ in range(8))]
            assert all(later > earlier for earlier, later in pairwise(indexes))
            lost, last = indexes[-1] - last - 8, indexes[-1]
            assert lost >= 3
            if lost == 3:  # a busy computer may lose some more, but not each time
                return
        raise AssertionError("more frames are missing than were lost, each time")

    def test_a_refused_setting_leaves_the_one_before(self, camera: Camera, faults: CameraFaults) -> None:
        allowed = camera.capabilities.exposure_range_s
        before_s = camera.set_exposure(min(2 * allowed.minimum, allowed.maximum))
        faults.refuse_next()
        with pytest.raises(DeviceError) as refused:
            camera.set_exposure(allowed.minimum)
        assert not isinstance(refused.value, Disconnected)
        assert camera.exposure_s == before_s
        camera.start()
        assert _whole_frame(camera).exposure_s == before_s


class LightContract:
    @pytest.mark.parametrize("check", LIGHT_CHECKS, ids=lambda check: check.__name__)
    def test_contract(self, light: LightSource, check: Callable[[LightSource], None]) -> None:
        check(light)
        assert not light.is_on

    def test_closes_for_good(self, light: LightSource) -> None:
        light_contract.check_closes_for_good(light)

    def test_opens_anew(self, light: LightSource, reopen: Callable[[], LightSource]) -> None:
        light_contract.check_opens_anew(light, reopen)


class LightFaultContract(LightContract):
    def test_shines_when_it_is_on_and_at_no_other_time(self, light: LightSource, faults: LightFaults) -> None:
        light.set_current(light.current_range_a.maximum)
        assert not faults.shines
        light.set_on(True)
        assert faults.shines
        light.set_on(False)
        assert not faults.shines
        light.set_on(True)
        light.close()
        assert not faults.shines

    def test_goes_off_at_any_fault(self, light: LightSource, faults: LightFaults) -> None:
        light.set_on(True)
        faults.fail_next()
        with pytest.raises(DeviceError):
            _ = light.current_a
        assert not faults.shines
        assert not light.is_on
        light.set_on(True)
        assert faults.shines

    def test_unplugged_every_call_says_so_and_it_closes(self, light: LightSource, faults: LightFaults) -> None:
        light.set_on(True)
        faults.unplug()
        _expect_within(Disconnected, lambda: light.set_on(True))
        for what, call in light_contract.calls_of(light).items():
            with pytest.raises(Disconnected):
                pytest.fail(f"{what} returned {call()}")
        assert light.name
        light.close()
        light.close()

    @pytest.mark.parametrize("question", ["is_on", "current_a"])
    def test_unplugged_while_lit_it_is_to_be_switched_off_by_hand(
        self, light: LightSource, faults: LightFaults, question: str
    ) -> None:
        light.set_on(True)
        faults.unplug()
        with pytest.raises(Disconnected, match=BY_HAND):
            getattr(light, question)
        with pytest.raises(Disconnected, match=BY_HAND):  # whoever asks
            light.set_on(False)
        light.close()

    def test_unplugged_while_lit_and_closed_it_is_to_be_switched_off_by_hand(
        self, light: LightSource, faults: LightFaults
    ) -> None:
        light.set_on(True)
        faults.unplug()
        with pytest.raises(Disconnected, match=BY_HAND):
            light.close()
        light.close()

    def test_unplugged_while_dark_nobody_needs_to_run(self, light: LightSource, faults: LightFaults) -> None:
        faults.unplug()
        with pytest.raises(Disconnected) as lost:
            _ = light.is_on
        assert BY_HAND not in str(lost.value)
        light.close()

    def test_unplugged_in_the_middle_of_a_command(self, light: LightSource, faults: LightFaults) -> None:
        light.set_on(True)
        allowed = light.current_range_a
        with own_time() as elapsed_s:
            pulled_s = _after_a_pause(faults.unplug, elapsed_s)
            with pytest.raises(Disconnected):
                _repeat(lambda: (light.set_current(allowed.minimum), light.set_current(allowed.maximum)))
            assert elapsed_s() - pulled_s() < AT_ONCE_S
        light.close()

    def test_plugged_in_again_it_can_be_opened_anew_and_is_off(
        self, light: LightSource, reopen: Callable[[], LightSource], faults: LightFaults
    ) -> None:
        light.set_on(True)
        faults.unplug()
        _expect_within(Disconnected, lambda: light.is_on)
        faults.plug_in()
        with pytest.raises(Disconnected):  # nobody knows what it forgot meanwhile
            _ = light.is_on
        light.close()
        with reopen() as again:
            assert not again.is_on
            assert not faults.shines
            again.set_on(True)
            assert faults.shines

    def test_a_refused_current_leaves_the_one_before(self, light: LightSource, faults: LightFaults) -> None:
        allowed = light.current_range_a
        before_a = light.set_current(allowed.minimum + (allowed.maximum - allowed.minimum) / 2)
        faults.refuse_next()
        with pytest.raises(DeviceError) as refused:
            light.set_current(allowed.maximum)
        assert not isinstance(refused.value, Disconnected)
        assert light.current_a == before_a
        assert not faults.shines


class StageContract:
    @pytest.mark.parametrize("check", STAGE_CHECKS, ids=lambda check: check.__name__)
    def test_contract(self, stage: Stage, check: Callable[[Stage], None]) -> None:
        check(stage)

    def test_closes_for_good(self, stage: Stage) -> None:
        stage_contract.check_closes_for_good(stage)


def _after_a_pause(happen: Callable[[], None], clock: Callable[[], float]) -> Callable[[], float]:
    """Let it happen from another thread, a moment later; the result tells when it did, by that clock."""
    happened_s: list[float] = []

    def act() -> None:
        happened_s.append(clock())
        happen()

    timer = threading.Timer(_PAUSE_S, act)
    timer.start()

    def when() -> float:
        timer.join()
        return happened_s[0]

    return when


def _expect_state(camera: Camera, state: CameraState) -> None:
    assert camera.state == state


def _expect_within(kind: type[DeviceError], call: Callable[[], object]) -> None:
    """Expect the error, and that it does not come late."""
    with own_time() as elapsed_s:
        with pytest.raises(kind):
            call()
        assert elapsed_s() < AT_ONCE_S


def _repeat(call: Callable[[], object]) -> None:
    """Call again and again until it fails, so that another thread gets its turn in the middle of a call.

    A thread that now and then lets go of the interpreter for a moment otherwise starves the others for seconds: they
    ask for their turn only when nobody has let go for a whole switch interval.
    """
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        deadline_s = time.monotonic() + HANG_S
        while time.monotonic() < deadline_s:
            call()
    finally:
        sys.setswitchinterval(before_s)


def _read(camera: Camera) -> None:
    """Read frames in slices, as the worker does; raise the timeout when none has come for longer than an exposure."""
    deadline_s = time.monotonic() + HANG_S
    silent = 0  # slices: a computer that stands still has not waited for that long
    while time.monotonic() < deadline_s:
        try:
            camera.read(_SLICE_S)
            silent = 0
        except FrameLost:
            continue
        except DeviceTimeout:
            silent += 1
            if silent * _SLICE_S > camera.exposure_s + 0.5:
                raise


def _whole_frame(camera: Camera) -> Frame:
    for _ in range(10):
        try:
            return camera.read(camera.exposure_s + 5.0)
        except FrameLost:
            continue
    raise AssertionError("ten frames in a row came damaged")
