"""Capture of the DCAM driver: intact numbered frames, counted losses, immediate stops."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from support.dcam_tools import dcam_stand_in, library, open_camera
from support.patience import HANG_S, own_time
from support.stand_ins.dcam.stand_in import Plug, StandIn, pattern

from drivers.dcam import DcamSettings
from drivers.dcam._properties import Id
from drivers.dcam.camera import DcamCamera
from drivers.interface import DeviceError, DeviceTimeout, Disconnected, Frame, FrameLost, Region, WrongState

RING = 16
REGION = Region(32, 64, 48, 80)
LOSTFRAME, INVALIDIMAGE, COOLINGTROUBLE = 0x80000301, 0x80000321, 0x80000302


@pytest.fixture
def camera(stand_in: StandIn) -> Iterator[DcamCamera]:
    with open_camera(stand_in, ring_frames=RING, exposure_s=0.02, region=REGION) as camera:
        camera.start()
        yield camera


def expect_whole(frame: Frame, number: int) -> None:
    """Assert an intact frame with this camera number."""
    np.testing.assert_array_equal(frame.pixels, pattern(number, REGION))


def test_frames_stay_intact_as_ring_wraps(camera: DcamCamera) -> None:
    for index in range(5 * RING + 3):
        frame = camera.read(1.0)
        assert frame.index == index
        assert frame.camera_time_s == pytest.approx(0.02 * (index + 1), abs=2e-6)
        expect_whole(frame, index)


def test_waiting_frames_are_read_in_order(stand_in: StandIn, camera: DcamCamera) -> None:
    for burst in (1, 3, RING - 1, RING - 2):
        first = camera.read(1.0).index + 1
        stand_in.advance(burst * 0.02 + 0.001)
        for index in range(first, first + burst):
            frame = camera.read(0.0)
            assert frame.index == index
            expect_whole(frame, index)
        with pytest.raises(DeviceTimeout):
            camera.read(0.0)


@pytest.mark.parametrize("late", [RING, RING + 1, 2 * RING, 10 * RING + 5])
def test_overrun_shows_as_gap(stand_in: StandIn, camera: DcamCamera, late: int) -> None:
    stand_in.advance(late * 0.02 + 0.001)
    for index in range(late - RING // 2, late + RING):  # half of the ring is skipped
        frame = camera.read(1.0)
        assert frame.index == index
        expect_whole(frame, index)


@pytest.mark.parametrize("late", [0, RING // 2, RING - 2])
@pytest.mark.parametrize("written", [-1, 0])  # its slot is half overwritten, or fully
def test_frame_overwritten_during_copy_is_skipped(
    stand_in: StandIn, camera: DcamCamera, late: int, written: int
) -> None:
    camera.read(1.0)
    stand_in.advance((late + 1) * 0.02 + 0.005)
    stand_in.slow("dcambuf_copyframe", 20 * (RING - late + written))
    with pytest.raises(DeviceTimeout):
        read_for(stand_in, camera, duration_s=5.0)
    stand_in.slow("dcambuf_copyframe", 0)
    frame = camera.read(1.0)
    assert frame.index > 1
    expect_whole(frame, frame.index)


def read_for(stand_in: StandIn, camera: DcamCamera, duration_s: float) -> None:
    """Assert that all frames are intact, up to a timeout, which is raised."""
    deadline_s = stand_in.now() + duration_s
    while stand_in.now() < deadline_s:
        frame = camera.read(0.1)
        expect_whole(frame, frame.index)
    raise DeviceTimeout


def test_frames_lost_before_transfer_show_as_gap(stand_in: StandIn, camera: DcamCamera) -> None:
    number = 0
    for lost in (1, 5, 3 * RING):
        assert camera.read(1.0).index == number
        stand_in.lose(lost)
        number += lost + 1
        frame = camera.read(3.0)
        assert frame.index == number
        expect_whole(frame, number)
        number += 1


def test_loss_without_stamps_is_gap_of_one(stand_in: StandIn) -> None:
    stand_in.remove(Id.FRAMESTAMP_PRODUCER)
    with open_camera(stand_in) as camera:
        camera.start()
        assert camera.read(1.0).index == 0
        stand_in.lose(3)
        assert [camera.read(1.0).index for _ in range(2)] == [2, 3]


def test_overrun_and_lost_frames_add_up(stand_in: StandIn, camera: DcamCamera) -> None:
    assert camera.read(1.0).index == 0
    stand_in.lose(7)
    stand_in.advance(0.02 * 107 + 0.001)
    frame = camera.read(1.0)  # 101 arrived (0, 8 ... 107), all but half a ring overwritten
    assert frame.index == 101 - RING // 2 + 7
    expect_whole(frame, frame.index)


def test_restarted_stamps_are_no_loss(camera: DcamCamera) -> None:
    camera.read(1.0)
    assert camera._capture is not None
    camera._capture._last = (0, 1000)  # as if the camera's numbers had been higher
    assert camera.read(1.0).index == 1


def test_stamps_of_16_bits_wrap_around(camera: DcamCamera) -> None:
    camera.read(1.0)
    assert camera._capture is not None
    camera._capture._last = (0, 2**16)
    assert camera.read(1.0).index == 1


def test_damaged_frame_raises_and_leaves_gap(stand_in: StandIn, camera: DcamCamera) -> None:
    assert camera.read(1.0).index == 0
    stand_in.fail("dcambuf_copyframe", INVALIDIMAGE)
    with pytest.raises(FrameLost):
        camera.read(1.0)
    frame = camera.read(1.0)
    assert frame.index == 2
    expect_whole(frame, 2)


def test_cooling_fault_is_raised(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.fail("dcamwait_start", COOLINGTROUBLE)
    with pytest.raises(DeviceError, match="cooling fails"):
        camera.read(1.0)
    assert camera.read(1.0).index == 0


def test_stalled_camera_times_out_and_continues(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.read(1.0)
    stand_in.stall()
    for timeout_s in (0.0, 0.05, 0.35):
        start_s = stand_in.now()
        with pytest.raises(DeviceTimeout):
            camera.read(timeout_s)
        assert stand_in.now() - start_s == pytest.approx(timeout_s, abs=2e-3)
    assert camera.state == "running"
    stand_in.stall(is_stalled=False)
    assert camera.read(1.0).index == 1


def test_camera_that_stopped_itself_restarts(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.read(1.0)
    stand_in.advance(0.05)
    stand_in.stop()
    assert [camera.read(1.0).index for _ in range(2)] == [1, 2]  # those already taken
    start_s = stand_in.now()
    with pytest.raises(WrongState, match="on its own"):
        camera.read(1.0)
    assert stand_in.now() == start_s  # noticed by an event, without waiting
    assert camera.state == "stopped"
    camera.set_binning(2)
    camera.start()
    assert camera.read(1.0).index == 0


def test_change_while_running_holds_from_next_frame(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.read(1.0)
    stand_in.advance(0.05)  # frames 1 and 2 wait, 3 is half exposed
    camera.set_exposure(0.1)
    camera.set_em_gain(50.0)
    camera.set_exposure(0.2)
    frames = [camera.read(1.0) for _ in range(5)]
    assert [frame.exposure_s for frame in frames] == [0.02, 0.02, 0.02, 0.2, 0.2]
    assert [frame.em_gain for frame in frames] == [4.0, 4.0, 4.0, 50.0, 50.0]
    assert np.diff([frame.camera_time_s for frame in frames]) == pytest.approx([0.02, 0.02, 0.2, 0.2], abs=2e-6)


@pytest.mark.parametrize("how", Plug)
def test_unplugged_during_long_exposure_raises_at_once(stand_in: StandIn, how: Plug) -> None:
    stand_in.answer_while_busy()
    with open_camera(stand_in, readout_speed=1, exposure_s=3.8) as camera:
        camera.start()
        camera.read(5.0)
        stand_in.unplug(how, after_s=1.9)
        start_s = stand_in.now()
        with pytest.raises(Disconnected):
            camera.read(10.0)
        assert stand_in.now() - start_s == pytest.approx(2.0, abs=0.11)


@pytest.mark.parametrize("trigger", ["internal", "external"])
def test_long_wait_needs_nothing_that_busy_camera_denies(stand_in: StandIn, trigger: str) -> None:
    with open_camera(stand_in, readout_speed=1, exposure_s=3.8, trigger=trigger) as camera:
        camera.start()
        if trigger == "external":
            with pytest.raises(DeviceTimeout):
                camera.read(5.0)
            stand_in.trigger()
        assert camera.read(5.0).index == 0
        assert (camera.state, camera.trigger) == ("running", trigger)


def test_silent_loss_that_busy_camera_hides_shows_at_stop(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.read(1.0)
    stand_in.unplug(Plug.SILENTLY)
    with pytest.raises(DeviceTimeout):
        camera.read(1.0)
    with pytest.raises(Disconnected, match="camera is gone"):
        camera.stop()
    assert camera.state == "lost"


def test_wait_slice_and_stop_take_under_200_ms(stand_in: StandIn) -> None:
    with open_camera(stand_in, readout_speed=1, exposure_s=3.8) as camera:
        camera.start()
        camera.read(5.0)
        start_s = stand_in.now()
        with pytest.raises(DeviceTimeout):
            camera.read(0.1)
        camera.stop()
        assert stand_in.now() - start_s < 0.2


@pytest.mark.parametrize("function", ["dcambuf_copyframe", "dcamcap_transferinfo", "dcamwait_start", "dcamcap_status"])
def test_any_first_failure_reveals_loss(stand_in: StandIn, camera: DcamCamera, function: str) -> None:
    stand_in.stall(is_stalled=function == "dcamcap_status")
    stand_in.fail(function, 0x80000F07)
    with pytest.raises(Disconnected, match=function):
        camera.read(1.0)
    assert camera.state == "lost"


# In real time: waits of another thread or a person.


@pytest.fixture
def in_real_time() -> Iterator[StandIn]:
    with dcam_stand_in(speed=1.0) as stand_in:
        yield stand_in


@pytest.fixture
def long_exposure(in_real_time: StandIn) -> Iterator[DcamCamera]:
    with DcamCamera(DcamSettings(readout_speed=1, exposure_s=600.0), library=library(in_real_time)) as camera:
        camera.start()
        yield camera


def duration_s(call: Callable[[], object]) -> float:
    with own_time() as elapsed_s:
        call()
        return elapsed_s()


def test_stop_interrupts_long_exposure(long_exposure: DcamCamera) -> None:
    def wait_and_stop() -> None:
        with pytest.raises(DeviceTimeout):
            long_exposure.read(0.1)
        long_exposure.stop()

    assert duration_s(wait_and_stop) < 2.0  # about 0.1 on a quiet machine


@pytest.mark.parametrize("is_abort_refused", [False, True])
def test_close_ends_read_of_another_thread(
    in_real_time: StandIn, long_exposure: DcamCamera, *, is_abort_refused: bool
) -> None:
    ended: list[BaseException] = []

    def wait() -> None:
        try:
            long_exposure.read(600.0)
        except DeviceError as error:
            ended.append(error)

    if is_abort_refused:
        in_real_time.fail("dcamwait_abort", 0x80000203)
    reader = threading.Thread(target=wait)
    reader.start()
    time.sleep(0.05)
    took_s = duration_s(long_exposure.close)
    reader.join(HANG_S)
    assert not reader.is_alive()
    assert isinstance(ended[0], WrongState)
    assert took_s < 2.0
    assert in_real_time.calls("dcamwait_abort") == 1
