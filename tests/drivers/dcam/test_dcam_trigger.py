"""Triggers of DCAM cameras."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
import pytest
from support.dcam_tools import open_camera
from support.stand_ins.dcam.stand_in import StandIn, pattern

from drivers.dcam._properties import Id
from drivers.dcam.camera import DcamCamera
from drivers.interface import DeviceTimeout, Disconnected, FrameLost, Region, Unsupported

SENSOR = Region(0, 0, 512, 512)
LOSTFRAME, NOTREADY = 0x80000301, 0x80000103


def test_external_trigger_makes_one_frame(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="external", exposure_s=0.05) as camera:
        camera.start()
        with pytest.raises(DeviceTimeout):
            camera.read(1.0)
        stand_in.trigger()
        assert camera.read(1.0).index == 0
        with pytest.raises(DeviceTimeout):
            camera.read(1.0)
        assert stand_in.calls("dcamcap_firetrigger") == 0


def test_change_before_trigger_holds_for_its_frame(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="external", exposure_s=0.05) as camera:
        camera.start()
        for exposure_s in (0.1, 0.2, 0.3):
            camera.set_exposure(exposure_s)
            stand_in.trigger()
            frame = camera.read(1.0)
            assert frame.exposure_s == exposure_s
            assert frame.camera_time_s == pytest.approx(stand_in.now(), abs=2e-6)


def test_leftover_trigger_settings_are_reset(camera: DcamCamera) -> None:
    """START would wait for a first pulse, several TIMES for several pulses per frame."""
    camera._properties.set(0x00100210, 6)
    camera._properties.set(0x00100240, 3)
    camera._set_up(camera._settings)
    properties = camera.properties()
    assert (properties["TRIGGER MODE"], properties["TRIGGER TIMES"]) == ("NORMAL", 1)


@pytest.mark.parametrize(("left", "reset"), [(1, 1), (2, 2), (3, 3), (4, 3), (5, 3)])
def test_leftover_global_reset_is_undone(
    camera: DcamCamera, left: int, reset: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = with_property(camera, Id.TRIGGER_GLOBALEXPOSURE, left, monkeypatch)
    camera._set_up(camera._settings)
    assert held() == reset


@pytest.mark.parametrize("can_change", [True, False])
def test_camera_left_in_mono8_is_set_to_mono16(
    camera: DcamCamera, can_change: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = with_property(camera, Id.IMAGE_PIXELTYPE, 1, monkeypatch, can_change=can_change)
    with nullcontext() if can_change else pytest.raises(Unsupported, match="only cameras that give one 16-bit number"):
        camera._set_up(camera._settings)
    assert held() == (2 if can_change else 1)


def with_property(
    camera: DcamCamera, identifier: Id, value: float, monkeypatch: pytest.MonkeyPatch, *, can_change: bool = True
) -> Callable[[], float]:
    """Give the camera a property of an ORCA, which the stand-in lacks; return what reads it."""
    values, held = camera._properties, value
    get_or, set_value = values.get_or, values.set

    def change(each: int, wanted: float) -> float:
        nonlocal held
        if each != identifier:
            return set_value(each, wanted)
        if not can_change:
            raise Unsupported("it is read-only")
        held = wanted
        return held

    monkeypatch.setattr(values, "get_or", lambda each, default: held if each == identifier else get_or(each, default))
    monkeypatch.setattr(values, "set", change)
    return lambda: held


def test_exposure_by_trigger_pulse_warns(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="external", trigger_active="level") as camera:
        assert camera.warnings() == ("the trigger pulses determine the exposure, not the set time",)


def test_each_read_fires_software_trigger(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.set_trigger("software")
    camera.start()
    for index in range(3):
        stand_in.advance(10.0)  # no frame meanwhile
        asked_s = stand_in.now()
        frame = camera.read(1.0)
        assert frame.index == index
        np.testing.assert_array_equal(frame.pixels, pattern(index, SENSOR))
        assert frame.camera_time_s == pytest.approx(asked_s + camera.exposure_s, abs=2e-6)
    assert stand_in.calls("dcamcap_firetrigger") == 3


def test_software_trigger_fires_once_for_slow_frame(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="software", exposure_s=0.5, readout_speed=2) as camera:
        camera.start()
        for timeout_s in (0.0, 0.1, 0.2):
            with pytest.raises(DeviceTimeout):
                camera.read(timeout_s)
        camera.set_exposure(0.1)  # holds from the next frame
        assert [camera.read(1.0).exposure_s for _ in range(3)] == [0.5, 0.1, 0.1]
        assert stand_in.calls("dcamcap_firetrigger") == 3


def test_software_trigger_fires_again_after_lost_frame(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="software") as camera:
        camera.start()
        assert camera.read(1.0).index == 0
        stand_in.lose(2)
        assert camera.read(1.0).index == 3
        stand_in.fail("dcambuf_copyframe", LOSTFRAME)
        with pytest.raises(FrameLost):
            camera.read(1.0)
        assert camera.read(1.0).index == 5


def test_lost_frame_restarts_camera_that_ignores_next_trigger(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.jam_on_loss()
    camera.set_trigger("software")
    camera.start()
    assert camera.read(1.0).index == 0
    stand_in.lose(1)
    for index in (2, 3):
        frame = camera.read(1.0)
        assert frame.index == index
        assert frame.pixels[0, 0] == index - 2  # the camera counts from 0 again


def test_refused_software_trigger_times_out(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="software") as camera:
        camera.start()
        stand_in.fail("dcamcap_firetrigger", NOTREADY, times=2)
        assert camera.read(1.0).index == 0  # the second attempt works
        stand_in.stall()
        for _ in range(2):
            with pytest.raises(DeviceTimeout):
                camera.read(0.5)
        camera.stop()
        stand_in.unplug()
        with pytest.raises(Disconnected):
            camera.start()
