"""The GenICam driver on the wire: Aravis's own GigE Vision camera, in a process that can be stopped and killed."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import run_state_machine_as_test
from support.camera_storm import CameraStorm
from support.device_contract import CameraFaultContract
from support.genicam_wire import FAKE_CAMERA, HERE, SERIAL, GigeWire, Peer
from support.patience import HANG_S, own_time
from support.storm import storm_settings

from drivers.camera import Camera
from drivers.errors import BadValue, Busy, DeviceError, DeviceTimeout, Disconnected, FrameLost, Unsupported, WrongState
from drivers.frame import Frame, Region
from drivers.genicam.camera import GenicamCamera
from drivers.genicam.discovery import discover
from drivers.genicam.library import load_aravis
from drivers.genicam.settings import GenicamSettings

NOTICED_S = 2.0  # within which a camera that is gone must be noticed
# The fake camera's pattern is scaled by 1 + log10(exposure / 10 ms): at 10 ms its pixels tell the frame's number.
TELLING = GenicamSettings(
    device=SERIAL, pixel_pitch_m=5e-6, exposure_s=0.01, frame_rate_hz=70.0, region=Region(8, 16, 96, 128), gain=0.0
)

try:
    load_aravis()
except Unsupported as error:
    pytest.skip(f"the extra genicam is not installed: {error}", allow_module_level=True)
if shutil.which(FAKE_CAMERA) is None:
    pytest.skip(f"there is no {FAKE_CAMERA}: sudo apt-get install aravis-tools", allow_module_level=True)


@pytest.fixture(scope="module")
def _peer() -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.kill()


@pytest.fixture
def peer(_peer: Peer) -> Peer:
    """The camera, running."""
    _peer.ensure()
    return _peer


@pytest.fixture
def camera(peer: Peer) -> Iterator[GenicamCamera]:  # noqa: ARG001 - it must be there
    with GenicamCamera(TELLING) as camera:
        yield camera


def frame_number(frame: Frame) -> int:
    """The fake camera's own count of this frame, modulo 65535, from its pixels: 256 n modulo 65535 at the corner."""
    return int(frame.pixels[0, 0]) * 256 % 65535


def whole_frames(camera: GenicamCamera, count: int) -> list[Frame]:
    """The next frames that came whole."""
    frames: list[Frame] = []
    while len(frames) < count:
        with suppress(FrameLost):
            frames.append(camera.read(10.0))
    return frames


def assert_accounted(frames: list[Frame]) -> None:
    """Every frame's index is what its pixels say."""
    numbers = [frame_number(frame) for frame in frames]
    assert [(number - numbers[0]) % 65535 for number in numbers] == [frame.index - frames[0].index for frame in frames]


def seconds_until_lost(call: Callable[[], object]) -> float:
    """Call until the camera is found gone, and return how long that took."""
    with own_time() as elapsed_s:
        while True:
            try:
                call()
            except Disconnected:
                return elapsed_s()
            except (DeviceTimeout, FrameLost):
                pass
            assert elapsed_s() < HANG_S


@pytest.fixture
def wire(peer: Peer) -> Iterator[GigeWire]:
    with GigeWire(peer) as wire:
        yield wire
        if not wire.is_whole:  # whoever was cut off holds the camera still
            peer.kill()


# Sequences: a plug that is pulled takes a second to be noticed.
FEW = 4
# not so many packets that Python could not pass them on, also where half of the sensor is read out
OVER_THE_WIRE = replace(TELLING, device=HERE, exposure_s=1e-4, frame_rate_hz=25.0, packet_size=16000)


class TestContract(CameraFaultContract):
    @pytest.fixture
    def faults(self, wire: GigeWire) -> GigeWire:
        return wire

    @pytest.fixture
    def reopen(self, wire: GigeWire) -> Callable[[], GenicamCamera]:  # noqa: ARG002 - it must be there
        return lambda: GenicamCamera(OVER_THE_WIRE)

    @pytest.fixture
    def camera(self, reopen: Callable[[], GenicamCamera]) -> Iterator[GenicamCamera]:
        with reopen() as camera:
            yield camera


def test_no_sequence_of_commands_and_faults_leaves_the_family(wire: GigeWire) -> None:
    class Storm(CameraStorm):
        longest_s = 60.0  # on the machine's clock, and the machine may be busy

        def now(self) -> float:
            return time.monotonic()

        def make(self) -> GigeWire:
            wire.mend()
            return wire

        def open(self) -> GenicamCamera:
            try:
                return GenicamCamera(OVER_THE_WIRE)
            except Disconnected:  # also where a busy computer was silent for so long that the camera gave it up
                if not wire.is_whole:
                    raise
                return GenicamCamera(OVER_THE_WIRE)

        def faults(self) -> st.SearchStrategy[str]:
            faults = ("unplug", "unplug_in_a_frame", "stall", "lose_two", "refuse_next", "garble_next", "delay_next")
            return st.sampled_from(faults)

        def happen(self, fault: str) -> None:
            getattr(wire, fault)()

        def recover(self) -> None:
            wire.mend()

    run_state_machine_as_test(Storm, settings=storm_settings(FEW))


@pytest.mark.parametrize("fault", ["garble_next", "delay_next"])
def test_a_reply_that_is_garbage_or_late_is_asked_for_again(wire: GigeWire, fault: str) -> None:
    with GenicamCamera(OVER_THE_WIRE) as camera:
        for exposure_s in (0.001, 0.002):
            getattr(wire, fault)()
            assert camera.set_exposure(exposure_s) == camera.exposure_s == exposure_s


def test_the_numbers_of_the_frames_go_round_on_the_wire(peer: Peer) -> None:
    peer.kill()
    peer.start()  # switched on, it counts from 65400
    with GenicamCamera(replace(TELLING, frame_rate_hz=250.0)) as camera:
        camera.start()
        frames = whole_frames(camera, 150)
        assert_accounted(frames)
        numbers = [frame_number(frame) for frame in frames]
        assert max(numbers) > 65500
        assert min(numbers) < 100


def test_a_cable_that_is_cut_within_a_frame(wire: GigeWire) -> None:
    with GenicamCamera(OVER_THE_WIRE) as camera:
        camera.start()
        whole_frames(camera, 2)
        wire.unplug_in_a_frame()
        with own_time() as elapsed_s:
            with suppress(FrameLost):  # what had come of it
                while True:
                    camera.read(10.0)
            seconds_until_lost(lambda: camera.read(10.0))
            assert elapsed_s() < NOTICED_S


def test_frames_at_70_per_second_are_all_accounted_for(camera: GenicamCamera) -> None:
    camera.start()
    frames = whole_frames(camera, 140)
    assert frames[0].index == 0
    assert_accounted(frames)
    spacing_s = np.diff([frame.camera_time_s for frame in frames]) / np.diff([frame.index for frame in frames])
    assert 0.9 / 70 < np.median(spacing_s) < 1  # on the camera's clock; a busy computer may slow this camera down
    assert (np.diff([frame.host_time_s for frame in frames]) > 0).all()


def test_the_pixels_are_those_that_were_sent(camera: GenicamCamera) -> None:
    camera.start()
    frame = whole_frames(camera, 1)[0]
    y, x = np.indices((96, 128))
    np.testing.assert_array_equal(frame.pixels, 256 * (x + y + frame_number(frame)) % 65535)


@pytest.mark.usefixtures("peer")
def test_eight_bits_are_eight_bits() -> None:
    with GenicamCamera(replace(TELLING, pixel_format="Mono8")) as camera:
        assert camera.capabilities.full_scale == 255
        camera.start()
        pixels = whole_frames(camera, 1)[0].pixels
        y, x = np.indices((96, 128))
        np.testing.assert_array_equal(pixels, (int(pixels[0, 0]) + x + y) % 255)


def test_lost_packets_are_lost_frames_and_nothing_else(peer: Peer) -> None:
    peer.kill()
    peer.start("--gvsp-lost-ratio=10")  # per thousand packets, with 20 in a frame
    with GenicamCamera(TELLING) as camera:
        camera.start()
        frames: list[Frame] = []
        lost = 0
        while len(frames) < 60:
            try:
                frames.append(camera.read(10.0))
            except FrameLost:
                lost += 1
        assert_accounted(frames)
        assert lost > 0
        assert frames[-1].index - frames[0].index > 59
        assert camera.properties()["incomplete_frames"] == lost
    peer.kill()


@pytest.mark.usefixtures("peer")
def test_who_reads_too_slowly_sees_a_gap() -> None:
    with GenicamCamera(replace(TELLING, buffers=3)) as camera:
        camera.start()
        first = whole_frames(camera, 1)
        time.sleep(0.5)
        frames = first + whole_frames(camera, 10)
        assert_accounted(frames)
        assert frames[-1].index - frames[0].index > 10


def test_a_camera_that_goes_before_a_command_is_missed(peer: Peer) -> None:
    with GenicamCamera(TELLING) as camera:
        camera.start()
        peer.kill()
        assert seconds_until_lost(camera.stop) < NOTICED_S
        assert camera.state == "lost"
    peer.start()
    with GenicamCamera(TELLING) as camera:  # the same one, found again
        camera.start()
        assert whole_frames(camera, 1)[0].index == 0


def test_a_camera_that_restarts_is_not_taken_for_the_same(peer: Peer) -> None:
    with GenicamCamera(TELLING) as camera:
        camera.start()
        whole_frames(camera, 3)
        peer.kill()
        peer.start()
        assert seconds_until_lost(lambda: camera.read(10.0)) < 3.5  # the library asks once in a second
    with GenicamCamera(TELLING) as camera:
        camera.start()
        assert whole_frames(camera, 3)[-1].index == 2


def test_a_camera_that_restarts_at_rest_is_lost_to_commands(peer: Peer) -> None:
    with GenicamCamera(TELLING) as camera:
        peer.kill()
        peer.start()

        def command() -> None:
            with suppress(WrongState):  # it denies us access, until the library has asked who has it
                camera.set_exposure(0.02)
            time.sleep(0.01)

        assert seconds_until_lost(command) < 3.5
        assert camera.state == "lost"


def test_a_short_silence_is_a_timeout_and_no_loss(camera: GenicamCamera, peer: Peer) -> None:
    camera.start()
    frames = whole_frames(camera, 3)
    peer.send(signal.SIGSTOP)
    with suppress(DeviceTimeout):
        while True:  # what had come before is read first
            frames.append(camera.read(0.05))
    peer.send(signal.SIGCONT)
    frames += whole_frames(camera, 5)
    assert_accounted(frames)


def test_a_long_silence_is_a_loss_and_the_camera_can_be_opened_again(peer: Peer) -> None:
    with GenicamCamera(TELLING) as camera:
        camera.start()
        peer.send(signal.SIGSTOP)
        while True:
            try:
                camera.read(0.1)
            except (DeviceTimeout, FrameLost):
                break
        assert seconds_until_lost(lambda: camera.read(0.1)) < NOTICED_S
    peer.send(signal.SIGCONT)
    with open_when_free() as camera:
        camera.start()
        assert whole_frames(camera, 2)[-1].index == 1


def test_a_camera_that_is_never_triggered_is_only_late(camera: GenicamCamera) -> None:
    assert camera.capabilities.triggers == ("internal", "Line0")
    camera.set_trigger("Line0")
    assert camera.trigger == "Line0"
    camera.start()
    begin_s = time.perf_counter()
    while time.perf_counter() - begin_s < 1.5:  # longer than silence is forgiven to one that does not answer
        with pytest.raises(DeviceTimeout):
            camera.read(0.3)
    assert camera.state == "running"
    with pytest.raises(WrongState):
        camera.set_trigger("internal")
    camera.stop()
    camera.set_trigger("internal")
    assert camera.trigger == "internal"
    camera.start()
    assert whole_frames(camera, 2)[-1].index == 1


def test_the_exposure_in_force_is_whole_microseconds(camera: GenicamCamera) -> None:
    taken_s = camera.set_exposure(0.0123456)
    assert taken_s == camera.exposure_s
    assert taken_s == pytest.approx(0.012345, abs=1.1e-6)
    assert round(taken_s * 1e6, 6) % 1 == 0


def test_a_part_of_the_sensor_is_read_out(camera: GenicamCamera) -> None:
    assert camera.capabilities.sensor == Region(0, 0, 2048, 2048)
    part = Region(100, 200, 48, 80)
    assert camera.set_region(part) == camera.region == part
    assert (camera.capabilities.rows, camera.capabilities.columns) == (48, 80)
    camera.start()
    assert whole_frames(camera, 1)[0].pixels.shape == (48, 80)
    with pytest.raises(WrongState):
        camera.set_region(part)
    camera.stop()
    for wrong in (Region(0, 0, 0, 8), Region(2000, 0, 100, 100), Region(-1, 0, 8, 8)):
        with pytest.raises(BadValue):
            camera.set_region(wrong)
    assert camera.region == part


def test_binning_keeps_the_part_of_the_sensor(camera: GenicamCamera) -> None:
    camera.set_binning(2)
    assert camera.binning == 2
    assert camera.region == TELLING.region
    assert (camera.capabilities.rows, camera.capabilities.columns) == (48, 64)
    assert camera.capabilities.pixel_pitch_m == pytest.approx(2 * 5e-6)
    camera.start()
    assert whole_frames(camera, 1)[0].pixels.shape == (48, 64)
    camera.stop()
    with pytest.raises(BadValue):
        camera.set_binning(17)


@pytest.mark.usefixtures("peer")
def test_how_large_its_pixels_are_need_not_be_known() -> None:
    with GenicamCamera(replace(TELLING, pixel_pitch_m=None)) as camera:
        assert camera.capabilities.pixel_pitch_m is None  # this one does not tell


@pytest.mark.usefixtures("peer")
def test_what_was_left_in_the_camera_does_not_count() -> None:
    with GenicamCamera(replace(TELLING, binning=2, trigger="Line0", pixel_format="Mono8")):
        pass
    with GenicamCamera(TELLING) as camera:
        assert camera.binning == 1
        assert camera.trigger == "internal"
        assert camera.capabilities.full_scale == 65535
        assert camera.region == TELLING.region


def test_a_camera_that_was_left_running_sends_to_whom_it_should(peer: Peer) -> None:
    peer.leave_running()
    with GenicamCamera(TELLING) as camera:
        time.sleep(0.3)  # it would have begun by now
        camera.start()
        assert whole_frames(camera, 2)[-1].index == 1


@pytest.mark.parametrize("which", range(1, 8))
def test_a_mode_that_is_refused_half_way_is_taken_back(wire: GigeWire, which: int) -> None:
    changes: tuple[Callable[[Camera], object], ...] = (
        lambda camera: camera.set_region(Region(4, 2, 80, 60)),
        lambda camera: camera.set_binning(2),
        lambda camera: camera.set_trigger("Line0"),
    )
    with GenicamCamera(OVER_THE_WIRE) as camera:
        before = camera.properties()
        for change in changes:
            wire.refuse(which)
            try:
                change(camera)
            except WrongState:
                assert camera.properties() == before
            else:  # in fewer steps
                assert which > 4
                wire.mend()
                camera.set_trigger("internal")
                camera.set_binning(1)
                assert OVER_THE_WIRE.region is not None
                camera.set_region(OVER_THE_WIRE.region)
                assert camera.properties() == before


def test_all_that_matters_is_recorded(camera: GenicamCamera) -> None:
    properties = camera.properties()
    assert properties["name"] == f"Aravis Fake {SERIAL}"
    assert properties["protocol"] == "GigE Vision"
    assert properties["pixel_format"] == "Mono16"
    assert properties["gain"] == 0
    assert properties["packet_size"] == 1400
    assert properties["frame_rate_hz"] == pytest.approx(70, rel=1e-3)
    assert properties["exposure_s"] == 0.01


@pytest.mark.usefixtures("peer")
@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (replace(TELLING, exposure_s=100.0), "exposure_s = 100 is outside"),
        (replace(TELLING, gain=11.0), "gain = 11 is outside 0"),
        (replace(TELLING, pixel_format="Mono12"), "Mono12 is not one of Mono16, Mono8"),
        (replace(TELLING, trigger="Line7"), "no trigger 'Line7'; there are internal, Line0"),
        (replace(TELLING, region=Region(0, 0, 4096, 4096)), "does not lie on the sensor"),
    ],
)
def test_a_setting_that_the_camera_refuses_is_told(asked: GenicamSettings, sentence: str) -> None:
    with pytest.raises(BadValue, match=sentence):
        GenicamCamera(asked)
    GenicamCamera(TELLING).close()  # and the camera is free again


@pytest.mark.usefixtures("peer")
def test_it_is_found_by_every_name_it_has() -> None:
    (found,) = discover()
    assert found.name == f"genicam:Aravis-Fake-{SERIAL}"
    assert found.description == f"Aravis Fake {SERIAL}"
    for device in ("", SERIAL, f"Aravis-Fake-{SERIAL}", "127.0.0.1"):
        with GenicamCamera(replace(TELLING, device=device)) as camera:
            assert camera.name == found.description
    with pytest.raises(Disconnected, match=f"no GenICam camera NONE; there are Aravis-Fake-{SERIAL}"):
        GenicamCamera(replace(TELLING, device="NONE"))


def test_one_that_is_off_is_not_found(peer: Peer) -> None:
    GenicamCamera(TELLING).close()
    peer.kill()
    with pytest.raises(Disconnected, match="does not answer"):
        GenicamCamera(TELLING)  # known from before
    assert discover() == ()
    with pytest.raises(Disconnected, match=f"no GenICam camera {SERIAL}: none answers"):
        GenicamCamera(TELLING)


HOLDER = """
from drivers.genicam.camera import GenicamCamera
from drivers.genicam.settings import GenicamSettings
camera = GenicamCamera(GenicamSettings(device={serial!r}, pixel_pitch_m=5e-6))
print("open", flush=True)
input()
camera.close()
"""


@pytest.mark.usefixtures("peer")
def test_a_camera_that_another_program_has_is_busy() -> None:
    code = HOLDER.format(serial=SERIAL)
    held = [sys.executable, "-c", code]
    with subprocess.Popen(held, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:  # noqa: S603 - ours
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"open\n"
        with pytest.raises(Busy, match="another program has the camera"):
            GenicamCamera(TELLING)
        holder.communicate(b"\n")
    with GenicamCamera(TELLING) as camera:
        assert camera.state == "stopped"


def open_when_free() -> GenicamCamera:
    """The camera, as soon as it has noticed that whoever held it is gone."""
    deadline_s = time.perf_counter() + HANG_S
    while True:
        try:
            return GenicamCamera(TELLING)
        except Busy:
            assert time.perf_counter() < deadline_s


def test_library_errors_become_device_errors(camera: GenicamCamera) -> None:
    with pytest.raises(DeviceError, match="the camera refuses the request"):
        camera._line.integer("NoSuchFeature")
    with pytest.raises(Unsupported):
        camera._line.call("arv_camera_execute_command", b"Width")  # a number is no command
