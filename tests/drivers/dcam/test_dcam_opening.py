"""Discovery, opening, closing and loss of DCAM cameras."""

from __future__ import annotations

import pytest
from support.dcam_tools import library, open_camera
from support.stand_ins.dcam.stand_in import Plug, StandIn

from drivers.dcam._properties import Id
from drivers.dcam.camera import DcamCamera, discover
from drivers.interface import BadValue, Busy, DeviceError, DeviceTimeout, Disconnected, Frame

OUTOFRANGE = 0x80000822


def read_patiently(camera: DcamCamera) -> Frame:
    while True:
        try:
            return camera.read(0.1)
        except DeviceTimeout:
            continue


def test_discovery_opens_no_camera(stand_in: StandIn) -> None:
    stand_in.attach(2)
    stand_in.hold()
    found = discover(library(stand_in))
    assert [(camera.description, camera.name) for camera in found] == [
        ("Hamamatsu C9100-23B, serial 000123", "dcam:000123"),
        ("Hamamatsu C9100-23B, serial 000456", "dcam:000456"),
    ]
    assert {(camera.kind, camera.driver) for camera in found} == {("camera", "dcam")}
    assert not stand_in.calls("dcamdev_open")
    stand_in.attach(0)
    assert discover(library(stand_in)) == ()


def test_discovery_works_while_camera_is_open(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.start()
    assert [found.settings for found in discover(library(stand_in))] == [{"device": "000123"}]
    assert camera.read(1.0).index == 0


def test_one_of_several_cameras_must_be_named(stand_in: StandIn) -> None:
    stand_in.attach(2)
    with pytest.raises(BadValue, match=r"000123.*000456"):
        open_camera(stand_in)
    with pytest.raises(Disconnected, match="no Hamamatsu camera 789"):
        open_camera(stand_in, device="789")
    with open_camera(stand_in, device="0") as first, open_camera(stand_in, device="000456") as second:
        assert first.name.endswith("000123")
        assert second.name.endswith("000456")
        first.start()
        second.start()
        second.close()
        assert first.read(1.0).index == 0
    assert stand_in.calls("dcamapi_init") == stand_in.calls("dcamapi_uninit") == 3  # one per opening


def test_missing_camera_is_reported(stand_in: StandIn) -> None:
    stand_in.attach(0)
    with pytest.raises(Disconnected, match="no Hamamatsu camera was found"):
        open_camera(stand_in)


def test_failed_init_is_undone(stand_in: StandIn) -> None:
    stand_in.attach(0)
    assert discover(library(stand_in)) == ()
    stand_in.attach(1)
    open_camera(stand_in).close()  # in the same process


def test_camera_opens_after_other_program_releases_it(stand_in: StandIn) -> None:
    stand_in.hold()
    for _ in range(2):
        with pytest.raises(Busy, match="another program"):
            open_camera(stand_in)
    assert stand_in.calls("dcamapi_uninit") == 2  # otherwise the camera would stay taken
    stand_in.hold(is_held=False)
    open_camera(stand_in).close()


def test_close_releases_everything_and_camera_reopens(stand_in: StandIn) -> None:
    for _ in range(3):
        camera = open_camera(stand_in)
        camera.start()
        camera.read(1.0)
        camera.close()
        camera.close()
        assert camera.state == "closed"
    for begin, end in (("dcamapi_init", "dcamapi_uninit"), ("dcamdev_open", "dcamdev_close")):
        assert stand_in.calls(begin) == stand_in.calls(end) == 3
    for begin, end in (("dcambuf_alloc", "dcambuf_release"), ("dcamwait_open", "dcamwait_close")):
        assert stand_in.calls(begin) == stand_in.calls(end) == 3


@pytest.mark.parametrize(
    "function", ["dcamwait_abort", "dcamcap_stop", "dcambuf_release", "dcamwait_close", "dcamdev_close"]
)
def test_failing_close_step_does_not_stop_the_others(stand_in: StandIn, function: str) -> None:
    camera = open_camera(stand_in)
    camera.start()
    stand_in.fail(function, 0x80000203)
    camera.close()
    assert stand_in.calls("dcamapi_uninit") == 1
    open_camera(stand_in).close()


def test_failed_stop_can_be_repeated(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.start()
    stand_in.fail("dcamcap_stop", 0x80000106)
    with pytest.raises(DeviceTimeout):
        camera.stop()
    assert camera.is_running
    assert camera.read(1.0).index == 0
    camera.stop()
    assert camera.state == "stopped"


def test_unreleased_ring_is_released_later(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.start()
    stand_in.fail("dcambuf_release", 0x80000106, times=2)
    camera.stop()
    assert camera.state == "stopped"
    with pytest.raises(DeviceTimeout):
        camera.set_binning(2)
    camera.set_binning(2)
    camera.start()
    assert camera.read(1.0).index == 0


def test_amplifier_is_restored_if_gain_preparation_fails(stand_in: StandIn) -> None:
    with open_camera(stand_in, amplifier="normal") as camera:
        stand_in.refuse(Id.DIRECTEMGAIN_MODE, OUTOFRANGE)
        with pytest.raises(BadValue):
            camera.set_amplifier("em")
        assert camera.amplifier == "normal"


@pytest.mark.parametrize("running", [False, True])
def test_setting_same_amplifier_keeps_settings(camera: DcamCamera, *, running: bool) -> None:
    camera.set_readout_speed(1)
    camera.set_exposure(3.8)
    if running:
        camera.start()
        camera.stop()
    camera.set_amplifier("em")
    assert (camera.readout_speed, camera.exposure_s) == (1, 3.8)


@pytest.mark.parametrize("function", ["dcamwait_open", "dcambuf_alloc", "dcamcap_start"])
def test_failed_start_can_be_repeated(stand_in: StandIn, camera: DcamCamera, function: str) -> None:
    stand_in.fail(function, 0x80000203)
    with pytest.raises(DeviceError, match="NOMEMORY"):
        camera.start()
    assert camera.state == "stopped"
    camera.set_binning(2)  # blocked by a remaining ring
    camera.start()
    assert camera.read(1.0).index == 0


@pytest.mark.parametrize("how", Plug)
def test_unplugged_camera_is_lost_and_reopens(stand_in: StandIn, how: Plug) -> None:
    stand_in.answer_while_busy()
    camera = open_camera(stand_in)
    camera.start()
    stand_in.unplug(how)
    started_s = stand_in.now()
    with pytest.raises(Disconnected, match="connect again"):
        read_patiently(camera)
    assert stand_in.now() - started_s <= 0.2
    assert camera.state == "lost"
    assert camera.name
    with pytest.raises(Disconnected):
        camera.set_exposure(0.1)
    camera.close()
    with pytest.raises(Disconnected):
        open_camera(stand_in)
    stand_in.plug_in()
    with open_camera(stand_in) as again:
        again.start()
        assert again.read(1.0).index == 0


@pytest.mark.parametrize("how", [Plug.TOLD, Plug.HALFWAY])
@pytest.mark.parametrize("command", ["set_exposure", "start", "set_amplifier", "stop", "properties"])
def test_loss_during_command_is_raised(stand_in: StandIn, how: Plug, command: str) -> None:
    with open_camera(stand_in) as camera:
        if command == "stop":
            camera.start()
        stand_in.slow("dcamprop_setgetvalue", 20)
        stand_in.slow("dcamprop_getname", 20)
        stand_in.slow("dcambuf_alloc", 20)
        stand_in.slow("dcamcap_stop", 20)
        stand_in.unplug(how, after_s=0.01)
        arguments = {"set_exposure": (0.1,), "set_amplifier": ("normal",)}.get(command, ())
        with pytest.raises(Disconnected):
            getattr(camera, command)(*arguments)
        assert camera.state == "lost"
