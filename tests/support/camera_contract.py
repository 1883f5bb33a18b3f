"""Contract tests for every camera, simulated or real over its stand-in.

Subclass and supply the fixtures: `camera`, open and stopped; `reopen`, which opens the same one again; and `faults` for
the fault contract. `drivers/contract/` holds the checks themselves.
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
from drivers.contract.camera import CAMERA_CHECKS
from drivers.interface import Camera, CameraState, DeviceError, DeviceTimeout, Disconnected, Frame, FrameLost
from support.patience import HANG_S, own_time

AT_ONCE_S = 2.0  # until a pulled plug must be noticed
_PAUSE_S = 0.03


def after_pause(happen: Callable[[], None], clock: Callable[[], float]) -> Callable[[], float]:
    """Call `happen` from another thread after a pause; the result returns when, on that clock."""
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


def expect_within(kind: type[DeviceError], call: Callable[[], object]) -> None:
    """Expect the error in time."""
    with own_time() as elapsed_s:
        with pytest.raises(kind):
            call()
        assert elapsed_s() < AT_ONCE_S


def repeat(call: Callable[[], object]) -> None:
    """Call until it fails, with a short switch interval, so that another thread acts during a call."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        deadline_s = time.monotonic() + HANG_S
        while time.monotonic() < deadline_s:
            call()
    finally:
        sys.setswitchinterval(before_s)


_SLICE_S = 0.005


class CameraFaults(Protocol):
    """Faults of a camera; each takes effect at once, also from another thread."""

    def unplug(self) -> None:
        """Pull the plug."""

    def plug_in(self) -> None:
        """Put the plug back, so that the camera can be reopened."""

    def stall(self) -> None:
        """Send no further frame."""

    def lose_frames(self, count: int) -> None:
        """Lose or damage the next `count` frames."""

    def refuse_next(self) -> None:
        """Refuse the next setting."""


class CameraContract:
    @pytest.mark.parametrize("check", CAMERA_CHECKS, ids=lambda check: check.__name__)
    def test_camera_keeps_the_contract(self, camera: Camera, check: Callable[[Camera], None]) -> None:
        check(camera)
        _expect_state(camera, "stopped")

    def test_closes_and_refuses_further_calls(self, camera: Camera) -> None:
        camera_contract.check_closes(camera)

    def test_closed_during_pause_stays_closed(self, camera: Camera) -> None:
        camera.start()
        with camera.paused():
            camera.close()
        _expect_state(camera, "closed")

    def test_reopens_after_close(self, camera: Camera, reopen: Callable[[], Camera]) -> None:
        camera_contract.check_reopens(camera, reopen)


class CameraFaultContract(CameraContract):
    def test_unplugged_at_rest_every_call_raises_and_it_closes(self, camera: Camera, faults: CameraFaults) -> None:
        faults.unplug()
        expect_within(Disconnected, camera.start)
        _expect_state(camera, "lost")
        for what, call in camera_contract.calls_of(camera).items():
            with pytest.raises(Disconnected):
                pytest.fail(f"{what} returned {call()}")
        assert camera.name
        camera.close()
        camera.close()
        _expect_state(camera, "closed")

    def test_unplugged_during_exposure_raises_at_once(self, camera: Camera, faults: CameraFaults) -> None:
        camera.set_exposure(min(1.0, camera.capabilities.exposure_range_s.maximum))
        camera.start()
        with own_time() as elapsed_s:
            pulled_s = after_pause(faults.unplug, elapsed_s)
            with pytest.raises(Disconnected):
                _read(camera)
            assert elapsed_s() - pulled_s() < AT_ONCE_S
        _expect_state(camera, "lost")
        camera.close()

    def test_unplugged_during_pause_is_lost(self, camera: Camera, faults: CameraFaults) -> None:
        def lose() -> None:
            with camera.paused():
                faults.unplug()
                repeat(lambda: camera.exposure_s)

        camera.start()
        with pytest.raises(Disconnected):
            lose()
        _expect_state(camera, "lost")

    def test_unplugged_during_command_raises_at_once(self, camera: Camera, faults: CameraFaults) -> None:
        allowed = camera.capabilities.exposure_range_s
        with own_time() as elapsed_s:
            pulled_s = after_pause(faults.unplug, elapsed_s)
            with pytest.raises(Disconnected):
                repeat(lambda: camera.set_exposure(allowed.minimum))
            assert elapsed_s() - pulled_s() < AT_ONCE_S
        camera.close()

    def test_plugged_in_again_reopens(self, camera: Camera, reopen: Callable[[], Camera], faults: CameraFaults) -> None:
        camera.start()
        faults.unplug()
        with pytest.raises(Disconnected):
            _read(camera)
        faults.plug_in()
        with pytest.raises(Disconnected):  # it may have forgotten its settings
            camera.stop()
        camera.close()
        with reopen() as again:
            again.start()
            assert _whole_frame(again).index == 0

    def test_stalled_camera_times_out_and_stops(self, camera: Camera, faults: CameraFaults) -> None:
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
        frames = [_whole_frame(camera) for _ in range(4)]
        assert frames[0].index == 0
        period_s = min(later.camera_time_s - earlier.camera_time_s for earlier, later in pairwise(frames))
        losses = []
        for _ in range(10):
            faults.lose_frames(3)
            frames = [frames[-1], *(_whole_frame(camera) for _ in range(8))]
            assert all(later.index > earlier.index for earlier, later in pairwise(frames))
            counted = frames[-1].index - frames[0].index
            taken_s = frames[-1].camera_time_s - frames[0].camera_time_s
            assert (counted - 1) * period_s < taken_s  # no more than fit into that time
            losses.append(counted - 8)
            if losses[-1] == 3:  # a busy computer may lose some more, but not each time
                break
        assert min(losses) == 3

    def test_refused_exposure_changes_nothing(self, camera: Camera, faults: CameraFaults) -> None:
        allowed = camera.capabilities.exposure_range_s
        before_s = camera.set_exposure(min(2 * allowed.minimum, allowed.maximum))
        faults.refuse_next()
        with pytest.raises(DeviceError) as refused:
            camera.set_exposure(allowed.minimum)
        assert not isinstance(refused.value, Disconnected)
        assert camera.exposure_s == before_s
        camera.start()
        assert _whole_frame(camera).exposure_s == before_s


def _expect_state(camera: Camera, state: CameraState) -> None:
    assert camera.state == state


def _read(camera: Camera) -> None:
    """Read frames in slices, as the worker does; raise after a silence longer than an exposure."""
    deadline_s = time.monotonic() + HANG_S
    silent = 0  # slices, not seconds, in case this computer stalls
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
