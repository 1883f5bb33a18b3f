"""Micro-Manager's DemoCamera behind the driver: camera contract, settings, faults, storm."""

from __future__ import annotations

import gc
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import run_state_machine_as_test
from support.camera_contract import CameraContract, CameraFaultContract, repeat
from support.camera_storm import CameraStorm
from support.micro_manager_core import DemoCamera
from support.patience import HANG_S, own_time, wait_until
from support.storm import storm_settings

from drivers.interface import (
    BadValue,
    DeviceError,
    DeviceTimeout,
    Disconnected,
    FrameLost,
    Range,
    Region,
    Unsupported,
    WrongState,
)
from drivers.micro_manager import MicroManagerSettings
from drivers.micro_manager._core import LoadedCamera
from drivers.micro_manager.camera import MicroManagerCamera, discover
from reconstruction.annotated_settings import check


@pytest.fixture
def faults() -> DemoCamera:
    return DemoCamera()


@pytest.fixture
def camera(faults: DemoCamera) -> Iterator[MicroManagerCamera]:
    with faults.open() as camera:
        yield camera


class TestMicroManagerCamera(CameraFaultContract):
    @pytest.fixture
    def reopen(self, faults: DemoCamera) -> Callable[[], MicroManagerCamera]:
        return faults.open


class TestMicroManagerCameraBinned(CameraContract):
    """8 bits, binned, a region."""

    @pytest.fixture
    def reopen(self, faults: DemoCamera) -> Callable[[], MicroManagerCamera]:
        properties = {"PixelType": "8bit", "BitDepth": "8"}
        return lambda: faults.open(properties, binning=2, region=Region(16, 32, 128, 256), exposure_s=0.02)

    @pytest.fixture
    def camera(self, reopen: Callable[[], MicroManagerCamera]) -> Iterator[MicroManagerCamera]:
        with reopen() as camera:
            yield camera


def test_settings_reach_camera(faults: DemoCamera) -> None:
    with faults.open(
        {"Gain": "3", "MaximumExposureMs": "250"},
        pixel_pitch_m=6.5e-6,
        full_scale=4095,
        exposure_s=0.1,
        binning=4,
        region=Region(64, 128, 256, 192),
    ) as camera:
        core, allowed = faults.faulty.core, camera.capabilities
        assert float(core.getProperty("camera", "Gain")) == 3
        assert (core.getExposure(), core.getProperty("camera", "Binning")) == (100.0, "4")
        assert tuple(core.getROI()) == (32, 16, 48, 64)  # left, top, columns, rows, binned
        assert (allowed.rows, allowed.columns, allowed.full_scale) == (64, 48, 4095)
        assert allowed.pixel_pitch_m == pytest.approx(4 * 6.5e-6)
        assert allowed.exposure_range_s == Range(1e-3, 0.25)  # set before the camera was initialized
        properties = camera.properties()
        assert properties["Gain"] == core.getProperty("camera", "Gain")
        assert "a frame lost before it leaves no gap" in str(properties["frame numbers"])
        assert "75" in str(properties["Micro-Manager"])


@pytest.mark.parametrize(("bits", "full_scale"), [("10", 1023), ("12", 4095), ("16", 65535)])
def test_full_scale_follows_bits(faults: DemoCamera, bits: str, full_scale: int) -> None:
    with faults.open({"BitDepth": bits}) as camera:
        assert camera.capabilities.full_scale == full_scale


def test_frames_are_those_of_the_core(faults: DemoCamera) -> None:
    """The same still pattern, without noise, by a snap of Micro-Manager."""
    still = {"FastImage": "0", "Mode": "Color Test Pattern", "BitDepth": "12"}
    region = Region(100, 40, 60, 80)
    with faults.open(still, region=region) as camera:
        camera.start()
        frame = camera.read(5.0)
        camera.stop()
        core = faults.faulty.core
        core.snapImage()
        np.testing.assert_array_equal(frame.pixels, core.getImage())
    assert frame.pixels.shape == (60, 80)
    assert frame.pixels.std() > 0


@pytest.mark.parametrize(
    ("switch", "amplifier", "em_gain"),
    [("On", "Electron Multiplying", 300), ("Off", "Electron Multiplying", 1), ("On", "Conventional", 1)],
)
def test_em_gain_of_an_ixon_is_recorded(
    faults: DemoCamera, monkeypatch: pytest.MonkeyPatch, switch: str, amplifier: str, em_gain: float
) -> None:
    andor = {"EMSwitch": switch, "Gain": "300", "Output_Amplifier": amplifier}
    initialize, names, call = LoadedCamera.initialize, LoadedCamera.property_names, LoadedCamera.call

    def initialized(line: LoadedCamera, properties: dict[str, str]) -> None:
        initialize(line, properties)
        monkeypatch.setattr(LoadedCamera, "property_names", lambda line: (*names(line), *andor))

    def answer(line: LoadedCamera, name: str, *arguments: Any) -> Any:
        is_andor = name == "getProperty" and arguments[-1] in andor
        return andor[arguments[-1]] if is_andor else call(line, name, *arguments)

    monkeypatch.setattr(LoadedCamera, "initialize", initialized)
    monkeypatch.setattr(LoadedCamera, "call", answer)
    with faults.open() as camera:
        camera.start()
        assert (camera.em_gain, camera.read(HANG_S).em_gain) == (em_gain, em_gain)


def test_exposure_of_frames_follows_change(faults: DemoCamera) -> None:
    with faults.open(exposure_s=0.05) as camera:
        camera.start()
        camera.read(5.0)
        camera.set_exposure(0.2)
        frames = [camera.read(5.0)]
        assert frames[0].exposure_s == 0.05
        deadline_s = time.monotonic() + HANG_S
        while frames[-1].exposure_s != 0.2:  # earlier ones may wait
            assert time.monotonic() < deadline_s
            frames.append(camera.read(5.0))
        frames += [camera.read(5.0) for _ in range(3)]
        times_s = [frame.camera_time_s for frame in frames]
        for frame, took_s in zip(frames[1:], np.diff(times_s), strict=True):
            if frame.exposure_s == 0.2:
                assert took_s > 0.15
        assert frames[-1].exposure_s == 0.2


def test_unread_frames_are_overwritten_and_show_as_gap(faults: DemoCamera) -> None:
    with faults.open(ring_frames=4, exposure_s=1e-3) as camera:
        camera.start()
        camera.read(5.0)
        capacity = faults.faulty.core.getBufferTotalCapacity()
        wait_until(lambda: (camera._adapter.newest() or 0) > 5 * capacity)
        assert camera.read(5.0).index > capacity


def test_buffer_emptied_between_two_calls_is_no_error(faults: DemoCamera, camera: MicroManagerCamera) -> None:
    camera.start()
    faults.faulty.core.stopSequenceAcquisition("camera")
    faults.faulty.core.clearCircularBuffer()
    faults.faulty.getRemainingImageCount = lambda: 1  # type: ignore[method-assign] # as it was just before
    with pytest.raises(IndexError):
        faults.faulty.core.popNextImage()
    assert camera._adapter.pop() is None
    assert camera._adapter.newest() is None


def test_silent_camera_is_lost_after_exposure_and_two_seconds(faults: DemoCamera) -> None:
    with faults.open(exposure_s=0.5) as camera:
        camera.start()
        came_s = camera.read(5.0).host_time_s
        faults.stall()
        with own_time() as elapsed_s:
            with pytest.raises(DeviceTimeout):
                camera.read(2.0)
            with pytest.raises(Disconnected, match="no frame for"):
                camera.read(5.0)
            assert time.perf_counter() - came_s > 2.4
            assert elapsed_s() < 4.0
        assert camera.state == "lost"


def test_ending_long_exposure_is_no_silence(faults: DemoCamera) -> None:
    with faults.open(exposure_s=1.0) as camera:
        camera.start()
        faults.stall()
        camera.set_exposure(1e-3)
        with pytest.raises(DeviceTimeout):
            camera.read(2.5)
        with pytest.raises(Disconnected):
            camera.read(5.0)


def test_region_stays_if_adapter_resets_it_with_binning(faults: DemoCamera, camera: MicroManagerCamera) -> None:
    faults.faulty.resets_region = True
    region = camera.set_region(Region(16, 32, 128, 256))
    camera.set_binning(4)
    assert camera.region == region
    assert (camera.capabilities.rows, camera.capabilities.columns) == (32, 64)
    camera.set_region(Region(0, 0, 512, 512))
    camera.set_binning(1)
    assert camera.capabilities.rows == 512


@pytest.mark.parametrize("refusals", [1, 2])
def test_refused_region_takes_binning_back(faults: DemoCamera, camera: MicroManagerCamera, refusals: int) -> None:
    faults.faulty.resets_region = True
    region = camera.set_region(Region(16, 32, 128, 256))
    faults.faulty.refused += ["setROI"] * refusals
    with pytest.raises(DeviceError, match="setROI") as refused:
        camera.set_binning(4)
    assert camera.binning == 1
    if refusals == 1:
        assert camera.region == region
        assert isinstance(refused.value, BadValue)
    else:  # the region is lost, which no refusal may do
        assert type(refused.value) is DeviceError
        assert "set it again" in str(refused.value)


def test_region_keeps_a_pixel_when_binned(camera: MicroManagerCamera) -> None:
    camera.set_region(Region(7, 9, 3, 17))
    camera.set_binning(8)
    assert camera.region == Region(0, 8, 8, 16)
    camera.start()
    assert camera.read(5.0).pixels.shape == (1, 2)


def test_lack_of_memory_is_reported(faults: DemoCamera, camera: MicroManagerCamera) -> None:
    def lack(_: int) -> None:
        raise MemoryError

    faults.faulty.setCircularBufferMemoryFootprint = lack  # type: ignore[attr-defined] # injected fault
    with pytest.raises(DeviceError, match=r"lower camera\.ring_frames"):
        camera.start()
    assert camera.state == "stopped"


@pytest.mark.parametrize("is_stopping", [False, True])
def test_core_of_camera_that_does_not_stop_is_kept(faults: DemoCamera, *, is_stopping: bool) -> None:
    """Destroying a core whose camera runs hung or aborted the process about once in 300 times."""
    camera = faults.open()
    core = weakref.ref(faults.faulty)
    camera.start()
    if not is_stopping:
        faults.unplug()
        faults.faulty.does_stop = False
    camera.close()
    del camera, faults.faulty
    gc.collect()
    assert (core() is None) == is_stopping


def test_close_ends_read_of_another_thread(faults: DemoCamera, camera: MicroManagerCamera) -> None:
    ended: list[BaseException] = []

    def wait() -> None:
        try:
            camera.read(60.0)
        except DeviceError as error:
            ended.append(error)

    camera.set_exposure(1.0)
    camera.start()
    faults.stall()
    reader = threading.Thread(target=wait)
    reader.start()
    time.sleep(0.05)
    camera.close()
    reader.join(HANG_S)
    (error,) = ended
    assert isinstance(error, WrongState)


def test_camera_that_stopped_itself_restarts(faults: DemoCamera, camera: MicroManagerCamera) -> None:
    camera.start()
    camera.read(5.0)
    faults.faulty.core.stopSequenceAcquisition("camera")
    with pytest.raises(WrongState, match="on its own"):
        repeat(lambda: camera.read(1.0))
    assert camera.state == "stopped"
    camera.start()
    assert camera.read(5.0).index == 0


def test_frame_of_another_size_is_lost(faults: DemoCamera, camera: MicroManagerCamera) -> None:
    assert camera.capabilities.rows == 512
    faults.faulty.core.setROI(0, 0, 64, 32)  # behind the driver's back
    camera.start()
    with pytest.raises(FrameLost, match="unlike the region"):
        camera.read(5.0)


@pytest.mark.parametrize(
    ("settings", "error", "sentence"),
    [
        ({"device": "DShutter"}, BadValue, "is no camera"),
        ({"device": "Nothing"}, Unsupported, r"set camera.adapter_folder .* device interface is 75"),
        ({"adapter": "Andor"}, Unsupported, "install the maker's driver"),
        ({"properties": {"Colour": "red"}}, BadValue, "camera.properties: there is no Colour; there are .*Binning"),
        ({"properties": {"BitDepth": "13"}}, BadValue, "BitDepth = 13, allowed are 10, 11, 12"),
        ({"properties": {"Gain": "99"}}, BadValue, r"Gain = 99, allowed are -5 \.\.\. 8"),
        ({"properties": {"PixelType": "32bitRGB"}}, Unsupported, "one 8- or 16-bit number per pixel"),
        ({"exposure_s": 99.0}, BadValue, r"exposure_s = 99 is outside 0.001 \.\.\. 1"),
        ({"binning": 3}, BadValue, "there is no binning 3; there are 1, 2, 4, 8"),
        ({"region": Region(0, 0, 1000, 1000)}, BadValue, "does not lie on the sensor of 512 x 512"),
    ],
)
def test_refused_setting_says_what_to_do(
    faults: DemoCamera, settings: dict[str, Any], error: type[DeviceError], sentence: str
) -> None:
    with pytest.raises(error, match=sentence):
        faults.open(**settings)
    assert not faults.faulty.core.getLoadedDevices()[:-1]  # all but the core itself


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"adapter": "x/evil"}, "adapter must be a name of letters, digits"),
        ({"adapter": "..\\evil"}, "adapter must be a name of letters, digits"),
        ({"adapter": "DemoCamera\n"}, "adapter must be a name of letters, digits"),
    ],
)
def test_impossible_setting_names_its_key(settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        check(MicroManagerSettings(**({"adapter": "DemoCamera", "device": "DCam"} | settings)))


@pytest.mark.parametrize(
    ("texts", "binnings"),
    [
        (("1", "2", "4"), {1: "1", 2: "2", 4: "4"}),
        (("1x1", "2x2", "1x2", "2x1", "4X4"), {1: "1x1", 2: "2x2", 4: "4X4"}),
        (("Off",), {}),
    ],
)
def test_binning_texts(camera: MicroManagerCamera, texts: tuple[str, ...], binnings: dict[int, str]) -> None:
    def answer(name: str, *_: str) -> tuple[str, ...]:
        return {"getDevicePropertyNames": ("Binning",), "getAllowedPropertyValues": texts}[name]

    camera._adapter.call = answer  # type: ignore[method-assign] # stands in for the camera
    found = camera._find_binnings()
    del camera._adapter.call
    assert found == binnings


def test_missing_pymmcore_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymmcore", None)
    with pytest.raises(Unsupported, match=r"install the extra svwfs\[micro-manager\]"):
        MicroManagerCamera(MicroManagerSettings(adapter="DemoCamera", device="DCam"))


def test_discovery_says_how_to_name_a_camera() -> None:
    with pytest.raises(Unsupported, match="name adapter and device in a bench"):
        discover()


class Storm(CameraStorm):
    """On a small sensor, so that a sequence takes little time."""

    device: DemoCamera
    own_s: Callable[[], float]

    def now(self) -> float:
        return self.own_s()

    def make(self) -> DemoCamera:
        return DemoCamera()

    def open(self) -> MicroManagerCamera:
        small = {"OnCameraCCDXSize": "64", "OnCameraCCDYSize": "48", "MaximumExposureMs": "40"}
        return self.device.open(small)

    def faults(self) -> st.SearchStrategy[tuple[Any, ...]]:
        functions = ("setExposure", "setProperty", "setROI", "clearROI", "getExposure", "popNextImageMD")
        return st.one_of(
            st.tuples(st.sampled_from(["unplug", "plug_in", "stall"])),
            st.tuples(st.just("lose_frames"), st.integers(1, 20)),
            st.tuples(st.just("refuse"), st.sampled_from([*functions, "startContinuousSequenceAcquisition"])),
        )

    def happen(self, fault: tuple[Any, ...]) -> None:
        if fault[0] == "refuse":
            self.device.faulty.refused.append(fault[1])
        else:
            getattr(self.device, fault[0])(*fault[1:])

    def recover(self) -> None:
        self.device.plug_in()


def test_storm_raises_only_device_errors() -> None:
    with own_time() as own_s:
        Storm.own_s = staticmethod(own_s)
        run_state_machine_as_test(Storm, settings=storm_settings(20))
