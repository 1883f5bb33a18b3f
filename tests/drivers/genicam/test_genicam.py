"""GenICam driver over UDP, with Aravis's fake GigE Vision camera in a process of its own."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from genicam_stand_in import FAKE_CAMERA, HERE, SERIAL, TURN, GigeWire, Peer
from hypothesis import strategies as st
from hypothesis.stateful import run_state_machine_as_test
from support.camera_contract import CameraFaultContract
from support.camera_storm import CameraStorm
from support.patience import HANG_S, own_time, udp_socket
from support.storm import storm_settings

from drivers.camera import Camera, Frame, Region
from drivers.errors import BadValue, Busy, DeviceError, DeviceTimeout, Disconnected, FrameLost, Unsupported, WrongState
from drivers.genicam import GenicamSettings
from drivers.genicam._library import load_aravis
from drivers.genicam.camera import GenicamCamera, discover

NOTICED_S = 2.0  # until a loss must be noticed
# The fake camera scales its pattern by 1 + log10(exposure / 10 ms): at 10 ms its pixels encode the frame number.
NUMBERED = GenicamSettings(
    device=SERIAL, pixel_pitch_m=5e-6, exposure_s=0.01, frame_rate_hz=70.0, region=Region(8, 16, 96, 128), gain=0.0
)

pytestmark = pytest.mark.posix  # its stand-in is stopped by signals

try:
    load_aravis()
except Unsupported as error:
    pytest.skip(f"the extra genicam is not installed: {error}", allow_module_level=True)
if shutil.which(FAKE_CAMERA) is None:
    pytest.skip(f"there is no {FAKE_CAMERA}: sudo apt-get install aravis-tools", allow_module_level=True)


@pytest.fixture(scope="module")
def _peer() -> Iterator[Peer]:
    with udp_socket(TURN):  # until its last process has ended
        peer = Peer()
        yield peer
        peer.kill()


@pytest.fixture
def peer(_peer: Peer) -> Peer:
    """The camera process, running."""
    _peer.ensure()
    return _peer


@pytest.fixture
def camera(peer: Peer) -> Iterator[GenicamCamera]:  # noqa: ARG001 - must run
    with GenicamCamera(NUMBERED) as camera:
        yield camera


def frame_number(frame: Frame) -> int:
    """The fake camera's frame number n modulo 65535; its corner pixel is 256 n modulo 65535."""
    return int(frame.pixels[0, 0]) * 256 % 65535


def whole_frames(camera: GenicamCamera, count: int) -> list[Frame]:
    """Read the next undamaged frames."""
    frames: list[Frame] = []
    while len(frames) < count:
        with suppress(FrameLost):
            frames.append(camera.read(10.0))
    return frames


def assert_accounted(frames: list[Frame]) -> None:
    """Assert that every index agrees with the number in the pixels."""
    numbers = [frame_number(frame) for frame in frames]
    assert [(number - numbers[0]) % 65535 for number in numbers] == [frame.index - frames[0].index for frame in frames]


def seconds_until_lost(call: Callable[[], object]) -> float:
    """Call until the loss is noticed; return the time it took."""
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
        if not wire.is_whole:  # the cut-off driver still holds the camera
            peer.kill()


# Sequences; noticing a pulled plug takes a second.
FEW = 4
# few enough packets for the Python proxy
OVER_THE_WIRE = replace(NUMBERED, device=HERE, exposure_s=1e-4, frame_rate_hz=25.0, packet_size=16000)


class TestContract(CameraFaultContract):
    @pytest.fixture
    def faults(self, wire: GigeWire) -> GigeWire:
        return wire

    @pytest.fixture
    def reopen(self, wire: GigeWire) -> Callable[[], GenicamCamera]:  # noqa: ARG002 - must run
        return lambda: GenicamCamera(OVER_THE_WIRE)

    @pytest.fixture
    def camera(self, reopen: Callable[[], GenicamCamera]) -> Iterator[GenicamCamera]:
        with reopen() as camera:
            yield camera


def test_storm_raises_only_device_errors(wire: GigeWire) -> None:
    class Storm(CameraStorm):
        longest_s = 60.0  # real time on a busy machine

        def now(self) -> float:
            return time.monotonic()

        def make(self) -> GigeWire:
            wire.mend()
            return wire

        def open(self) -> GenicamCamera:
            try:
                return GenicamCamera(OVER_THE_WIRE)
            except Disconnected:  # also if a busy computer let the connection time out
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
def test_garbled_or_late_reply_is_requested_again(wire: GigeWire, fault: str) -> None:
    with GenicamCamera(OVER_THE_WIRE) as camera:
        for exposure_s in (0.001, 0.002):
            getattr(wire, fault)()
            assert camera.set_exposure(exposure_s) == camera.exposure_s == exposure_s


def test_frame_numbers_wrap_around_on_the_wire(peer: Peer) -> None:
    peer.kill()
    peer.start()  # counts from 65400 after power-on
    with GenicamCamera(replace(NUMBERED, frame_rate_hz=250.0)) as camera:
        camera.start()
        frames = whole_frames(camera, 150)
        assert_accounted(frames)
        numbers = [frame_number(frame) for frame in frames]
        assert numbers[-1] < numbers[0]


def test_cable_cut_within_frame_is_a_loss(wire: GigeWire) -> None:
    with GenicamCamera(OVER_THE_WIRE) as camera:
        camera.start()
        whole_frames(camera, 2)
        wire.unplug_in_a_frame()
        with own_time() as elapsed_s:
            with suppress(FrameLost):  # the incomplete frame
                while True:
                    camera.read(10.0)
            seconds_until_lost(lambda: camera.read(10.0))
            assert elapsed_s() < NOTICED_S


def test_all_frames_at_70_hz_are_accounted_for(camera: GenicamCamera) -> None:
    camera.start()
    frames = whole_frames(camera, 140)
    assert frames[0].index == 0
    assert_accounted(frames)
    spacing_s = np.diff([frame.camera_time_s for frame in frames]) / np.diff([frame.index for frame in frames])
    assert 0.9 / 70 < np.median(spacing_s) < 1  # a busy computer may slow this camera down
    assert (np.diff([frame.host_time_s for frame in frames]) > 0).all()


def test_pixels_arrive_as_sent(camera: GenicamCamera) -> None:
    camera.start()
    frame = whole_frames(camera, 1)[0]
    y, x = np.indices((96, 128))
    np.testing.assert_array_equal(frame.pixels, 256 * (x + y + frame_number(frame)) % 65535)


@pytest.mark.usefixtures("peer")
def test_eight_bit_format_works() -> None:
    with GenicamCamera(replace(NUMBERED, pixel_format="Mono8")) as camera:
        assert camera.capabilities.full_scale == 255
        camera.start()
        pixels = whole_frames(camera, 1)[0].pixels
        y, x = np.indices((96, 128))
        np.testing.assert_array_equal(pixels, (int(pixels[0, 0]) + x + y) % 255)


def test_lost_packets_lose_only_their_frames(peer: Peer, capfd: pytest.CaptureFixture[str]) -> None:
    peer.kill()
    peer.start("--gvsp-lost-ratio=10")  # per thousand packets, 20 per frame
    with GenicamCamera(NUMBERED) as camera:
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
    assert "CRITICAL" not in capfd.readouterr().err  # as of the library, asked about half a frame


@pytest.mark.usefixtures("peer")
def test_slow_reader_sees_gap() -> None:
    with GenicamCamera(replace(NUMBERED, buffers=3)) as camera:
        camera.start()
        frames = whole_frames(camera, 1)
        deadline_s = time.monotonic() + HANG_S
        while frames[-1].index - frames[0].index < len(frames):  # the camera's process may rest meanwhile
            assert time.monotonic() < deadline_s
            time.sleep(0.5)
            frames += whole_frames(camera, 10)
        assert_accounted(frames)


def test_loss_before_command_is_noticed(peer: Peer) -> None:
    with GenicamCamera(NUMBERED) as camera:
        camera.start()
        peer.kill()
        assert seconds_until_lost(camera.stop) < NOTICED_S
        assert camera.state == "lost"
    peer.start()
    with GenicamCamera(NUMBERED) as camera:  # found again
        camera.start()
        assert whole_frames(camera, 1)[0].index == 0


def test_restarted_camera_is_lost(peer: Peer) -> None:
    with GenicamCamera(NUMBERED) as camera:
        camera.start()
        whole_frames(camera, 3)
        peer.kill()
        peer.start()
        assert seconds_until_lost(lambda: camera.read(10.0)) < 3.5  # the library polls once a second
    with GenicamCamera(NUMBERED) as camera:
        camera.start()
        assert whole_frames(camera, 3)[-1].index == 2


def test_camera_restarted_at_rest_is_lost(peer: Peer) -> None:
    with GenicamCamera(NUMBERED) as camera:
        peer.kill()
        peer.start()

        def command() -> None:
            with suppress(WrongState):  # access denied, until the library has polled
                camera.set_exposure(0.02)
            time.sleep(0.01)

        assert seconds_until_lost(command) < 3.5
        assert camera.state == "lost"


def test_short_silence_is_a_timeout(camera: GenicamCamera, peer: Peer) -> None:
    camera.start()
    frames = whole_frames(camera, 3)
    peer.send(signal.SIGSTOP)
    with suppress(DeviceTimeout):
        while True:  # earlier frames are read first
            frames.append(camera.read(0.05))
    peer.send(signal.SIGCONT)
    frames += whole_frames(camera, 5)
    assert_accounted(frames)


def test_long_silence_is_a_loss_and_camera_reopens(peer: Peer) -> None:
    with GenicamCamera(NUMBERED) as camera:
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


def test_untriggered_camera_only_times_out(camera: GenicamCamera) -> None:
    assert camera.capabilities.triggers == ("internal", "Line0")
    camera.set_trigger("Line0")
    assert camera.trigger == "Line0"
    camera.start()
    begin_s = time.perf_counter()
    while time.perf_counter() - begin_s < 1.5:  # longer than an unanswering camera is tolerated
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


def test_close_ends_read_of_another_thread(camera: GenicamCamera) -> None:
    ended: list[BaseException] = []

    def wait() -> None:
        try:
            camera.read(60.0)
        except DeviceError as error:
            ended.append(error)

    camera.set_trigger("Line0")
    camera.start()
    reader = threading.Thread(target=wait)
    reader.start()
    time.sleep(0.05)
    camera.close()
    reader.join(HANG_S)
    (error,) = ended
    assert str(error) == "the camera is being closed"


def test_binning_keeps_region(camera: GenicamCamera) -> None:
    camera.set_binning(2)
    assert camera.binning == 2
    assert camera.region == NUMBERED.region
    assert (camera.capabilities.rows, camera.capabilities.columns) == (48, 64)
    assert camera.capabilities.pixel_pitch_m == pytest.approx(2 * 5e-6)
    camera.start()
    assert whole_frames(camera, 1)[0].pixels.shape == (48, 64)
    camera.stop()
    with pytest.raises(BadValue):
        camera.set_binning(17)


@pytest.mark.usefixtures("peer")
def test_pixel_pitch_may_be_unknown() -> None:
    with GenicamCamera(replace(NUMBERED, pixel_pitch_m=None)) as camera:
        assert camera.capabilities.pixel_pitch_m is None  # not reported by this camera


@pytest.mark.usefixtures("peer")
def test_earlier_camera_settings_are_reset() -> None:
    with GenicamCamera(replace(NUMBERED, binning=2, trigger="Line0", pixel_format="Mono8")):
        pass
    with GenicamCamera(NUMBERED) as camera:
        assert camera.binning == 1
        assert camera.trigger == "internal"
        assert camera.capabilities.full_scale == 65535
        assert camera.region == NUMBERED.region


def test_camera_left_running_sends_to_new_owner(peer: Peer) -> None:
    peer.leave_running()
    with GenicamCamera(NUMBERED) as camera:
        time.sleep(0.3)  # time enough to begin
        camera.start()
        assert whole_frames(camera, 2)[-1].index == 1


@pytest.mark.parametrize("which", range(1, 8))
def test_mode_refused_half_way_is_restored(wire: GigeWire, which: int) -> None:
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
            else:  # fewer steps
                assert which > 3
                wire.mend()
                camera.set_trigger("internal")
                camera.set_binning(1)
                assert OVER_THE_WIRE.region is not None
                camera.set_region(OVER_THE_WIRE.region)
                assert camera.properties() == before


def test_properties_are_complete(camera: GenicamCamera) -> None:
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
        (replace(NUMBERED, exposure_s=100.0), "exposure_s = 100 is outside"),
        (replace(NUMBERED, gain=11.0), "gain = 11 is outside 0"),
        (replace(NUMBERED, pixel_format="Mono12"), "Mono12 is not one of Mono16, Mono8"),
        (replace(NUMBERED, trigger="Line7"), "no trigger 'Line7'; there are internal, Line0"),
        (replace(NUMBERED, region=Region(0, 0, 4096, 4096)), "does not lie on the sensor"),
    ],
)
def test_refused_setting_raises(asked: GenicamSettings, sentence: str) -> None:
    with pytest.raises(BadValue, match=sentence):
        GenicamCamera(asked)
    GenicamCamera(NUMBERED).close()  # the camera is free again


@pytest.mark.usefixtures("peer")
def test_camera_opens_by_every_name() -> None:
    (found,) = discover()
    assert found.name == f"genicam:Aravis-Fake-{SERIAL}"
    assert found.description == f"Aravis Fake {SERIAL}"
    for device in ("", SERIAL, f"Aravis-Fake-{SERIAL}", "127.0.0.1"):
        with GenicamCamera(replace(NUMBERED, device=device)) as camera:
            assert camera.name == found.description
    with pytest.raises(Disconnected, match=f"no GenICam camera NONE; there are Aravis-Fake-{SERIAL}"):
        GenicamCamera(replace(NUMBERED, device="NONE"))


def test_switched_off_camera_is_not_discovered(peer: Peer) -> None:
    GenicamCamera(NUMBERED).close()
    peer.kill()
    with pytest.raises(Disconnected, match="does not answer"):
        GenicamCamera(NUMBERED)  # known from earlier
    assert discover() == ()
    with pytest.raises(Disconnected, match=f"no GenICam camera {SERIAL}: none answers"):
        GenicamCamera(NUMBERED)


HOLDER = """
from drivers.genicam.camera import GenicamCamera
from drivers.genicam import GenicamSettings
camera = GenicamCamera(GenicamSettings(device={serial!r}, pixel_pitch_m=5e-6))
print("open", flush=True)
input()
camera.close()
"""


@pytest.mark.usefixtures("peer")
def test_camera_held_by_other_program_is_busy() -> None:
    code = HOLDER.format(serial=SERIAL)
    held = [sys.executable, "-c", code]
    with subprocess.Popen(held, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:  # noqa: S603 - ours
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"open\n"
        with pytest.raises(Busy, match="another program has the camera"):
            GenicamCamera(NUMBERED)
        holder.communicate(b"\n")
    with GenicamCamera(NUMBERED) as camera:
        assert camera.state == "stopped"


def open_when_free() -> GenicamCamera:
    """Open the camera once it has noticed the loss of its former owner."""
    deadline_s = time.perf_counter() + HANG_S
    while True:
        try:
            return GenicamCamera(NUMBERED)
        except Busy:
            assert time.perf_counter() < deadline_s
