"""The driver of Hamamatsu's cameras over the stand-in: the contract of all cameras, modes, limits, what it tells."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from dcam_tools import dcam_stand_in, library, open_camera
from device_contract import CameraContract, CameraFaultContract

from drivers.dcam.camera import DcamCamera
from drivers.dcam.property_ids import Id
from drivers.dcam.search import find
from drivers.dcam.settings import DcamSettings
from drivers.interface import (
    BadValue,
    Busy,
    DeviceError,
    DeviceTimeout,
    Disconnected,
    Frame,
    FrameLost,
    Range,
    Region,
    Unsupported,
    WrongState,
)
from simulated_devices.dcam.stand_in import Plug, StandIn, pattern

SENSOR = Region(0, 0, 512, 512)
EM_PROPERTIES = (0x00400310, 0x00200220, 0x00200250, 0x00200260, 0x00200270, 0x00200290, 0x002002A0, 0x002002B0)
INVALIDVALUE, OUTOFRANGE = 0x80000821, 0x80000822
LOSTFRAME, NOTREADY = 0x80000301, 0x80000103


@pytest.fixture
def stand_in() -> Iterator[StandIn]:
    with dcam_stand_in() as stand_in:
        yield stand_in


@pytest.fixture
def camera(stand_in: StandIn) -> Iterator[DcamCamera]:
    with open_camera(stand_in) as camera:
        yield camera


def read_patiently(camera: DcamCamera) -> Frame:
    while True:
        try:
            return camera.read(0.1)
        except DeviceTimeout:
            continue


class Hand:
    """At the camera's cable."""

    def __init__(self, stand_in: StandIn, how: Plug) -> None:
        self._stand_in = stand_in
        self._how = how

    def unplug(self) -> None:
        self._stand_in.unplug(self._how)

    def plug_in(self) -> None:
        self._stand_in.plug_in()

    def stall(self) -> None:
        self._stand_in.stall()

    def lose_frames(self, count: int) -> None:
        self._stand_in.lose(count)

    def refuse_next(self) -> None:
        self._stand_in.fail("dcamprop_setgetvalue", OUTOFRANGE)


class TestDcamCamera(CameraFaultContract):
    """In real time."""

    @pytest.fixture(params=[Plug.TOLD, Plug.HALFWAY], ids=lambda how: how.name.lower())
    def faults(self, stand_in: StandIn, request: pytest.FixtureRequest) -> Hand:
        return Hand(stand_in, request.param)

    @pytest.fixture
    def stand_in(self) -> Iterator[StandIn]:
        with dcam_stand_in(speed=1.0) as stand_in:
            yield stand_in

    @pytest.fixture
    def reopen(self, stand_in: StandIn) -> Callable[[], DcamCamera]:
        return lambda: DcamCamera(DcamSettings(), library(stand_in))

    @pytest.fixture
    def camera(self, reopen: Callable[[], DcamCamera]) -> Iterator[DcamCamera]:
        with reopen() as camera:
            yield camera


class TestDcamCameraAtLeisure(CameraContract):
    """A part of the sensor, binned, with the normal amplifier."""

    @pytest.fixture
    def reopen(self, stand_in: StandIn) -> Callable[[], DcamCamera]:
        return lambda: open_camera(stand_in, amplifier="normal", binning=2, region=Region(16, 32, 128, 256))

    @pytest.fixture
    def camera(self, reopen: Callable[[], DcamCamera]) -> Iterator[DcamCamera]:
        with reopen() as camera:
            yield camera


class TestDcamCameraTriggeredByWhoReads(CameraContract):
    """Nobody else fires the software trigger."""

    @pytest.fixture
    def reopen(self, stand_in: StandIn) -> Callable[[], DcamCamera]:
        return lambda: open_camera(stand_in, trigger="software", region=Region(16, 32, 128, 256))

    @pytest.fixture
    def camera(self, reopen: Callable[[], DcamCamera]) -> Iterator[DcamCamera]:
        with reopen() as camera:
            yield camera


# Modes: what is allowed is asked anew after each change.


def test_exposure_limits_follow_amplifier_and_speed(camera: DcamCamera) -> None:
    assert camera.capabilities.exposure_range_s == Range(0.0139, 1.0)
    with pytest.raises(BadValue, match=r"0\.0139 \.\.\. 1"):
        camera.set_exposure(3.8)
    camera.set_readout_speed(1)
    assert camera.capabilities.exposure_range_s == Range(0.42147, 7200.0)
    assert camera.set_exposure(3.8) == 3.8
    camera.set_readout_speed(2)
    assert camera.capabilities.exposure_range_s == Range(0.02713, 7200.0)
    assert camera.exposure_s == 3.8
    camera.set_amplifier("normal")
    assert camera.capabilities.readout_speeds == (1,)
    with pytest.raises(BadValue):
        camera.set_exposure(0.15)
    camera.set_amplifier("em")
    assert camera.readout_speed == 3
    assert camera.exposure_s == 1.0  # moved into the range


def test_exposures_are_rounded_to_the_cameras_steps(camera: DcamCamera) -> None:
    assert camera.set_exposure(0.0200049) == pytest.approx(0.02, abs=1e-12)
    assert camera.set_exposure(0.0200051) == camera.exposure_s == pytest.approx(0.02001, abs=1e-12)


def test_a_camera_that_does_not_round_is_given_whole_steps(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.set_rounding(is_automatic=False)
    assert camera.set_exposure(0.0200049) == pytest.approx(0.02, abs=1e-12)
    assert camera.set_exposure(1.0) == 1.0
    camera.set_readout_speed(2)
    assert camera.set_exposure(7200.0) == 7200.0  # 27.13 ms and so many steps are more, in floating point


def test_settings_of_the_bench_are_taken(stand_in: StandIn) -> None:
    region = Region(64, 128, 256, 192)
    with open_camera(
        stand_in,
        device="000123",
        amplifier="em",
        readout_speed=1,
        exposure_s=3.8,
        em_gain=50,
        em_gain_protection_frames=7,
        em_gain_warning_level=2,
        binning=2,
        region=region,
        trigger="external",
        trigger_active="level",
        trigger_polarity="positive",
        trigger_delay_s=0.001,
        output="exposure",
        output_polarity="positive",
        cooler="max",
    ) as camera:
        assert (camera.readout_speed, camera.exposure_s, camera.em_gain, camera.binning) == (1, 3.8, 50.0, 2)
        assert (camera.region, camera.trigger) == (region, "external")
        told = camera.properties()
        expected = {
            "TRIGGER ACTIVE": "LEVEL",
            "TRIGGER POLARITY": "POSITIVE",
            "TRIGGER DELAY": 0.001,
            "OUTPUT TRIGGER KIND": "EXPOSURE",
            "OUTPUT TRIGGER KIND[1]": "LOW",
            "OUTPUT TRIGGER POLARITY": "POSITIVE",
            "SENSOR COOLER": "MAX",
            "EM GAIN PROTECT MODE": "ON",
            "EM GAIN PROTECT AFTER FRAMES": 7,
            "EM GAIN WARNING LEVEL": 2,
        }
        assert {name: told[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"exposure_s": 0.0}, "exposure_s must be positive"),
        ({"exposure_s": float("nan")}, "exposure_s must be positive"),
        ({"pixel_pitch_m": -1.0}, "pixel_pitch_m must be positive"),
        ({"readout_speed": 0}, "readout_speed must be at least 1"),
        ({"em_gain": -1.0}, "em_gain must be 0 or positive"),
        ({"em_gain": 5.0, "amplifier": "normal"}, 'em_gain needs amplifier = "em"'),
        ({"em_gain_protection_frames": 0}, r"em_gain_protection_frames must be 1 \.\.\. 255"),
        ({"em_gain_warning_level": 4}, "em_gain_warning_level must be 1, 2 or 3"),
        ({"binning": 0}, r"binning must be 1 \.\.\. 16"),
        ({"trigger_delay_s": -0.1}, "trigger_delay_s must be 0 or positive"),
        ({"ring_frames": 3}, r"ring_frames must be 4 \.\.\. 10000"),
    ],
)
def test_impossible_settings_name_their_key(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        DcamSettings(**settings)  # type: ignore[arg-type] # wrong on purpose


def test_settings_that_the_camera_cannot_take_let_it_go_again(stand_in: StandIn) -> None:
    with pytest.raises(BadValue, match=r"exposure_s = 3.8 is outside 0.0139 \.\.\. 1"):
        open_camera(stand_in, exposure_s=3.8)
    with pytest.raises(BadValue, match="there is no binning 3"):
        open_camera(stand_in, binning=3)
    open_camera(stand_in).close()


# Regions and binning


@pytest.mark.parametrize("binning", [1, 2, 4])
@pytest.mark.parametrize("region", [Region(0, 0, 16, 16), Region(496, 480, 16, 32), Region(64, 0, 256, 512), SENSOR])
def test_the_part_that_is_asked_for_is_read_out(camera: DcamCamera, region: Region, binning: int) -> None:
    camera.set_binning(binning)
    camera.set_region(Region(496, 496, 16, 16))  # as far away as can be
    assert camera.set_region(region) == camera.region == region
    assert camera.capabilities.rows == region.rows // binning
    assert camera.capabilities.columns == region.columns // binning
    assert camera.capabilities.pixel_pitch_m == pytest.approx(16e-6 * binning)
    camera.start()
    np.testing.assert_array_equal(camera.read(1.0).pixels, pattern(0, region, binning))


@pytest.mark.parametrize(
    "region", [Region(1, 0, 16, 16), Region(0, 0, 20, 16), Region(496, 0, 32, 16), Region(-16, 0, 16, 16)]
)
def test_a_region_off_the_sensor_or_its_steps_is_refused(camera: DcamCamera, region: Region) -> None:
    with pytest.raises(BadValue, match="in steps of 16"):
        camera.set_region(region)
    assert camera.region == SENSOR


@pytest.mark.parametrize("failing", [Id.SUBARRAYHSIZE, Id.SUBARRAYVPOS])
def test_a_region_that_is_refused_half_way_leaves_the_one_before(
    stand_in: StandIn, camera: DcamCamera, failing: Id
) -> None:
    before = camera.set_region(Region(32, 48, 64, 80))
    writes = {Id.SUBARRAYHSIZE: 2, Id.SUBARRAYVPOS: 4}[failing]
    stand_in.fail("dcamprop_setgetvalue", OUTOFRANGE, after=writes)
    with pytest.raises(BadValue, match="subarray"):
        camera.set_region(Region(0, 0, 128, 128))
    assert camera.region == before
    assert (camera.capabilities.rows, camera.capabilities.columns) == (64, 80)


def test_modes_cannot_be_changed_while_running(camera: DcamCamera) -> None:
    camera.start()
    for change in (
        lambda: camera.set_readout_speed(1),
        lambda: camera.set_binning(2),
        lambda: camera.set_region(Region(0, 0, 16, 16)),
        lambda: camera.set_trigger("external"),
    ):
        with pytest.raises(WrongState):
            change()
    camera.stop()
    camera.set_readout_speed(1)


def test_a_value_that_the_camera_refuses_is_told_with_what_is_allowed(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.refuse(Id.EXPOSURETIME, INVALIDVALUE)
    before_s = camera.exposure_s
    with pytest.raises(BadValue, match=r"exposure time = 0.5, allowed are 0.0139 \.\.\. 1"):
        camera.set_exposure(0.5)
    assert camera.exposure_s == before_s


# EM gain


def test_the_em_gain_is_the_true_multiplication(camera: DcamCamera) -> None:
    assert camera.capabilities.em_gain_range == Range(4.0, 1200.0)
    assert camera.set_em_gain(300.4) == camera.em_gain == 300.0
    camera.start()
    assert camera.read(1.0).em_gain == 300.0
    assert camera.properties()["MEASURED SENSITIVITY"] == pytest.approx(300.0)
    camera.stop()
    camera.set_amplifier("normal")
    assert camera.capabilities.em_gain_range == Range(1.0, 1.0)
    assert camera.set_em_gain(1.0) == camera.em_gain == 1.0
    with pytest.raises(BadValue):
        camera.set_em_gain(2.0)
    camera.set_amplifier("em")
    assert camera.properties()["DIRECT EM GAIN MODE"] == "ON"


@pytest.mark.parametrize("code", [0x80000F03, 0x80000825])
def test_a_question_that_fails_is_not_taken_for_a_camera_without_em_gain(
    stand_in: StandIn, camera: DcamCamera, code: int
) -> None:
    assert camera.em_gain == 4.0
    stand_in.fail("dcamprop_getvalue", code)
    with pytest.raises(Unsupported):
        _ = camera.em_gain
    assert camera.em_gain == 4.0


def test_a_relative_em_gain_is_told_as_such(stand_in: StandIn) -> None:
    stand_in.remove(Id.DIRECTEMGAIN_MODE)
    with open_camera(stand_in) as camera:
        assert camera.capabilities.em_gain_range == Range(0.0, 255.0)
        assert any("own scale" in sentence for sentence in camera.warnings())


def test_a_camera_without_em_gain_is_an_ordinary_one(stand_in: StandIn) -> None:
    stand_in.remove(*EM_PROPERTIES, Id.READOUTSPEED, Id.SUBARRAYMODE, Id.TRIGGERSOURCE, Id.BINNING)
    with open_camera(stand_in) as camera:
        allowed = camera.capabilities
        assert (allowed.amplifiers, allowed.readout_speeds, allowed.triggers) == (("normal",), (1,), ("internal",))
        assert (allowed.binnings, allowed.sensor, allowed.em_gain_range) == ((1,), None, Range(1.0, 1.0))
        assert (camera.amplifier, camera.em_gain, camera.readout_speed, camera.region) == ("normal", 1.0, 1, SENSOR)
        camera.set_amplifier("normal")
        camera.set_readout_speed(1)
        camera.set_binning(1)
        camera.set_trigger("internal")
        camera.start()
        assert camera.read(1.0).em_gain == 1.0
        assert camera.warnings() == ()


def test_a_property_that_goes_with_the_mode_is_no_longer_asked_for(stand_in: StandIn, camera: DcamCamera) -> None:
    assert list(camera.capabilities.triggers) == ["internal", "external", "software"]
    stand_in.remove(Id.TRIGGERSOURCE)
    camera.set_binning(2)
    assert list(camera.capabilities.triggers) == ["internal"]
    assert camera.trigger == "internal"


def test_a_camera_that_does_not_tell_its_pixels_needs_to_be_told(stand_in: StandIn) -> None:
    stand_in.remove(Id.IMAGEDETECTOR_PIXELWIDTH)
    with pytest.raises(Unsupported, match=r"set camera\.pixel_pitch_m"):
        open_camera(stand_in)
    with open_camera(stand_in, pixel_pitch_m=6.5e-6) as camera:
        assert camera.capabilities.pixel_pitch_m == 6.5e-6


def test_too_much_light_is_warned_of_and_black_frames_are_no_frames(stand_in: StandIn) -> None:
    with open_camera(stand_in, em_gain_protection_frames=3) as camera:
        camera.start()
        stand_in.overexpose()
        for _ in range(3):
            camera.read(1.0)
        assert camera.warnings() == ("too much light for this EM gain: it ages the multiplication register",)
        with pytest.raises(DeviceError, match="protects its EM register"):
            camera.read(1.0)
        assert any("black" in sentence for sentence in camera.warnings())
        camera.stop()
        stand_in.overexpose(is_overexposed=False)
        camera.start()
        assert camera.read(1.0).pixels.any()


def test_without_protection_the_frames_go_on(stand_in: StandIn) -> None:
    with open_camera(stand_in, em_gain_protection=False) as camera:
        stand_in.overexpose()
        camera.start()
        for _ in range(10):
            assert camera.read(1.0).pixels.any()


# What it tells


def test_every_readable_property_is_told(camera: DcamCamera) -> None:
    told = camera.properties()
    assert told["exposure_s"] == told["EXPOSURE TIME"] == 0.0139
    expected = {
        "CONVERSION FACTOR COEFF": 5.8,
        "CONVERSION FACTOR OFFSET": 500.0,
        "SENSOR TEMPERATURE": -65.0,
        "RECURSIVE FILTER": "OFF",
        "SUBTRACT": "OFF",
        "SHADING CORRECTION": "OFF",
        "READOUT SPEED": 3,
        "model": "C9100-23B",
        "warnings": "",
    }
    assert {name: told[name] for name in expected} == expected
    assert "STORE SUBTRACT IMAGE TO MEMORY" not in told  # can only be written


@pytest.mark.parametrize(
    ("identifier", "value", "word"),
    [
        (Id.RECURSIVEFILTER, 2, "averages frames"),
        (Id.FRAMEAVERAGINGMODE, 2, "averages frames"),
        (Id.SPOTNOISEREDUCER, 2, "single pixels"),
        (Id.SUBTRACT, 2, "subtracts"),
        (Id.SHADINGCORRECTION, 2, "shading"),
        (Id.INTENSITYLUT_MODE, 3, "table"),
        (Id.PHOTONIMAGINGMODE, 1, "photon imaging"),
        (Id.CAPTUREMODE, 2, "calibration"),
    ],
)
def test_filters_in_the_camera_are_warned_of(camera: DcamCamera, identifier: Id, value: float, word: str) -> None:
    assert camera.warnings() == ()
    camera._values.set(identifier, value)
    (warning,) = camera.warnings()
    assert word in warning
    assert camera.properties()["warnings"] == warning


def test_a_warm_sensor_is_warned_of(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.break_cooler()
    (warning,) = camera.warnings()
    assert "cooler is in trouble at 12.5 degC" in warning


def test_a_property_that_cannot_be_read_now_says_so_in_its_place(stand_in: StandIn, camera: DcamCamera) -> None:
    before = len(camera.properties())
    calls = stand_in.calls("dcamprop_getvalue")
    camera.properties()
    last = stand_in.calls("dcamprop_getvalue") - calls - 40
    stand_in.fail("dcamprop_getvalue", 0x8000082C, after=last)
    told = camera.properties()
    assert len(told) == before
    assert sum("ACCESSDENY" in str(value) for value in told.values()) == 1


# Finding, opening, closing


def test_cameras_are_found_without_opening_them(stand_in: StandIn) -> None:
    stand_in.attach(2)
    stand_in.hold()
    found = find(library(stand_in))
    assert [(camera.description, camera.name) for camera in found] == [
        ("Hamamatsu C9100-23B, serial 000123", "dcam:000123"),
        ("Hamamatsu C9100-23B, serial 000456", "dcam:000456"),
    ]
    assert {(camera.kind, camera.driver) for camera in found} == {("camera", "dcam")}
    assert not stand_in.calls("dcamdev_open")
    stand_in.attach(0)
    assert find(library(stand_in)) == ()


def test_cameras_are_found_while_one_of_them_is_open(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.start()
    assert [found.settings for found in find(library(stand_in))] == [{"device": "000123"}]
    assert camera.read(1.0).index == 0


def test_one_of_several_has_to_be_named(stand_in: StandIn) -> None:
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
    assert stand_in.calls("dcamapi_init") == stand_in.calls("dcamapi_uninit") == 3  # one for each opening


def test_no_camera_is_told_as_that(stand_in: StandIn) -> None:
    stand_in.attach(0)
    with pytest.raises(Disconnected, match="no Hamamatsu camera was found"):
        open_camera(stand_in)


def test_a_camera_that_another_program_holds_can_be_opened_afterwards(stand_in: StandIn) -> None:
    stand_in.hold()
    for _ in range(2):
        with pytest.raises(Busy, match="another program"):
            open_camera(stand_in)
    assert stand_in.calls("dcamapi_uninit") == 2  # else it would stay taken
    stand_in.hold(is_held=False)
    open_camera(stand_in).close()


def test_closing_lets_go_of_everything_and_it_opens_anew(stand_in: StandIn) -> None:
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
def test_a_step_of_closing_that_fails_does_not_keep_the_others(stand_in: StandIn, function: str) -> None:
    camera = open_camera(stand_in)
    camera.start()
    stand_in.fail(function, 0x80000203)
    camera.close()
    assert stand_in.calls("dcamapi_uninit") == 1
    open_camera(stand_in).close()


def test_a_stop_that_fails_can_be_tried_again(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.start()
    stand_in.fail("dcamcap_stop", 0x80000106)
    with pytest.raises(DeviceTimeout):
        camera.stop()
    assert camera.is_running
    assert camera.read(1.0).index == 0
    camera.stop()
    assert camera.state == "stopped"


def test_a_ring_that_is_not_given_back_is_given_back_later(stand_in: StandIn, camera: DcamCamera) -> None:
    camera.start()
    stand_in.fail("dcambuf_release", 0x80000106, times=2)
    camera.stop()
    assert camera.state == "stopped"
    with pytest.raises(DeviceTimeout):
        camera.set_binning(2)
    camera.set_binning(2)
    camera.start()
    assert camera.read(1.0).index == 0


def test_an_amplifier_whose_gain_cannot_be_prepared_is_not_taken(stand_in: StandIn) -> None:
    with open_camera(stand_in, amplifier="normal") as camera:
        stand_in.refuse(Id.DIRECTEMGAIN_MODE, OUTOFRANGE)
        with pytest.raises(BadValue):
            camera.set_amplifier("em")
        assert camera.amplifier == "normal"


@pytest.mark.parametrize("running", [False, True])
def test_an_amplifier_that_is_in_use_keeps_its_settings(camera: DcamCamera, *, running: bool) -> None:
    camera.set_readout_speed(1)
    camera.set_exposure(3.8)
    if running:
        camera.start()
        camera.stop()
    camera.set_amplifier("em")
    assert (camera.readout_speed, camera.exposure_s) == (1, 3.8)


@pytest.mark.parametrize("function", ["dcamwait_open", "dcambuf_alloc", "dcamcap_start"])
def test_a_start_that_fails_leaves_a_camera_that_can_be_started(
    stand_in: StandIn, camera: DcamCamera, function: str
) -> None:
    stand_in.fail(function, 0x80000203)
    with pytest.raises(DeviceError, match="NOMEMORY"):
        camera.start()
    assert camera.state == "stopped"
    camera.set_binning(2)  # there is no buffer in the way
    camera.start()
    assert camera.read(1.0).index == 0


@pytest.mark.parametrize("how", Plug)
def test_an_unplugged_camera_is_lost_and_opens_anew(stand_in: StandIn, how: Plug) -> None:
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


@pytest.mark.parametrize("first", Plug)
@pytest.mark.parametrize("second", Plug)
def test_whoever_waits_sees_a_plug_that_is_pulled_twice(stand_in: StandIn, first: Plug, second: Plug) -> None:
    """The stand-in once waited for ever for the second moment, which was past."""
    with open_camera(stand_in) as camera:
        camera.start()
        stand_in.unplug(first)
        stand_in.unplug(second, after_s=0.05)
        with pytest.raises(Disconnected):
            read_patiently(camera)


@pytest.mark.parametrize("how", [Plug.TOLD, Plug.HALFWAY])
@pytest.mark.parametrize("command", ["set_exposure", "start", "set_amplifier", "stop", "properties"])
def test_a_camera_that_goes_in_the_middle_of_a_command_is_lost(stand_in: StandIn, how: Plug, command: str) -> None:
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


# Triggers


def test_an_external_trigger_makes_a_frame(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="external", exposure_s=0.05) as camera:
        camera.start()
        with pytest.raises(DeviceTimeout):
            camera.read(1.0)
        stand_in.trigger()
        assert camera.read(1.0).index == 0
        with pytest.raises(DeviceTimeout):
            camera.read(1.0)
        assert stand_in.calls("dcamcap_firetrigger") == 0


def test_a_change_before_a_trigger_holds_for_its_frame(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="external", exposure_s=0.05) as camera:
        camera.start()
        for exposure_s in (0.1, 0.2, 0.3):
            camera.set_exposure(exposure_s)
            stand_in.trigger()
            frame = camera.read(1.0)
            assert frame.exposure_s == exposure_s
            assert frame.camera_time_s == pytest.approx(stand_in.now(), abs=2e-6)


def test_an_exposure_that_pulses_make_is_warned_of(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="external", trigger_active="level") as camera:
        assert camera.warnings() == ("the trigger's pulses make the exposure, not the time that is set",)


def test_with_the_software_trigger_each_read_makes_its_frame(stand_in: StandIn, camera: DcamCamera) -> None:
    """So that whoever measures or looks needs not know that somebody has to trigger."""
    camera.set_trigger("software")
    camera.start()
    for index in range(3):
        stand_in.advance(10.0)  # nothing is taken meanwhile
        asked_s = stand_in.now()
        frame = camera.read(1.0)
        assert frame.index == index
        np.testing.assert_array_equal(frame.pixels, pattern(index, SENSOR))
        assert frame.camera_time_s == pytest.approx(asked_s + camera.exposure_s, abs=2e-6)
    assert stand_in.calls("dcamcap_firetrigger") == 3


def test_a_software_trigger_is_fired_once_for_a_frame_that_takes_long(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="software", exposure_s=0.5, readout_speed=2) as camera:
        camera.start()
        for timeout_s in (0.0, 0.1, 0.2):
            with pytest.raises(DeviceTimeout):
                camera.read(timeout_s)
        camera.set_exposure(0.1)  # holds from the next one on
        assert [camera.read(1.0).exposure_s for _ in range(3)] == [0.5, 0.1, 0.1]
        assert stand_in.calls("dcamcap_firetrigger") == 3


def test_a_software_trigger_is_fired_again_for_a_frame_that_was_lost(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="software") as camera:
        camera.start()
        assert camera.read(1.0).index == 0
        stand_in.lose(2)
        assert camera.read(1.0).index == 3
        stand_in.fail("dcambuf_copyframe", LOSTFRAME)
        with pytest.raises(FrameLost):
            camera.read(1.0)
        assert camera.read(1.0).index == 5


def test_a_camera_that_takes_no_software_trigger_times_out(stand_in: StandIn) -> None:
    with open_camera(stand_in, trigger="software") as camera:
        camera.start()
        stand_in.fail("dcamcap_firetrigger", NOTREADY, times=2)
        assert camera.read(1.0).index == 0  # asked again, it does
        stand_in.stall()
        for _ in range(2):
            with pytest.raises(DeviceTimeout):
                camera.read(0.5)
        camera.stop()
        stand_in.unplug()
        with pytest.raises(Disconnected):
            camera.start()
