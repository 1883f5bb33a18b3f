"""Triggers of DCAM cameras."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import pytest
from support.dcam_tools import open_camera
from support.stand_ins.dcam.stand_in import StandIn

from drivers.dcam._properties import Id
from drivers.dcam.camera import DcamCamera
from drivers.interface import DeviceTimeout, Unsupported


def test_external_trigger_makes_one_frame(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="external", exposure_s=0.05) as camera:
        camera.start()
        with pytest.raises(DeviceTimeout):
            camera.read(1.0)
        stand_in.trigger()
        assert camera.read(1.0).index == 0
        with pytest.raises(DeviceTimeout):
            camera.read(1.0)


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
