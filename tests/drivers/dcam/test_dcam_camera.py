"""DCAM camera over its stand-in: camera contract, modes, limits, regions."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from support.camera_contract import CameraContract, CameraFaultContract
from support.dcam_tools import dcam_stand_in, library, open_camera
from support.stand_ins.dcam.stand_in import Plug, StandIn, pattern

from drivers.dcam import DcamSettings
from drivers.dcam._properties import Id
from drivers.dcam.camera import DcamCamera
from drivers.interface import BadValue, Range, Region, WrongState
from reconstruction.annotated_settings import check

SENSOR = Region(0, 0, 512, 512)
INVALIDVALUE, OUTOFRANGE = 0x80000821, 0x80000822


class Faults:
    """Faults of the stand-in."""

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
    def faults(self, stand_in: StandIn, request: pytest.FixtureRequest) -> Faults:
        return Faults(stand_in, request.param)

    @pytest.fixture
    def stand_in(self) -> Iterator[StandIn]:
        with dcam_stand_in(speed=1.0) as stand_in:
            yield stand_in

    @pytest.fixture
    def reopen(self, stand_in: StandIn) -> Callable[[], DcamCamera]:
        return lambda: DcamCamera(DcamSettings(), library=library(stand_in))

    @pytest.fixture
    def camera(self, reopen: Callable[[], DcamCamera]) -> Iterator[DcamCamera]:
        with reopen() as camera:
            yield camera


class TestDcamCameraAtLeisure(CameraContract):
    """A binned region with the normal amplifier."""

    @pytest.fixture
    def reopen(self, stand_in: StandIn) -> Callable[[], DcamCamera]:
        return lambda: open_camera(stand_in, amplifier="normal", binning=2, region=Region(16, 32, 128, 256))

    @pytest.fixture
    def camera(self, reopen: Callable[[], DcamCamera]) -> Iterator[DcamCamera]:
        with reopen() as camera:
            yield camera


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


def test_exposure_is_rounded_to_camera_steps(camera: DcamCamera) -> None:
    assert camera.set_exposure(0.0200049) == pytest.approx(0.02, abs=1e-12)
    assert camera.set_exposure(0.0200051) == camera.exposure_s == pytest.approx(0.02001, abs=1e-12)


def test_driver_rounds_for_camera_without_rounding(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.set_rounding(is_automatic=False)
    assert camera.set_exposure(0.0200049) == pytest.approx(0.02, abs=1e-12)
    assert camera.set_exposure(1.0) == 1.0
    camera.set_readout_speed(2)
    assert camera.set_exposure(7200.0) == 7200.0  # more than the limit if summed up in steps, by rounding


def test_bench_settings_are_applied(stand_in: StandIn) -> None:
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
        properties = camera.properties()
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
        assert {name: properties[name] for name in expected} == expected


def test_gain_needs_the_em_amplifier() -> None:
    with pytest.raises(ValueError, match='em_gain needs amplifier = "em"'):
        check(DcamSettings(em_gain=5.0, amplifier="normal"))


def test_refused_settings_release_camera(stand_in: StandIn) -> None:
    with pytest.raises(BadValue, match=r"exposure_s = 3.8 is outside 0.0139 \.\.\. 1"):
        open_camera(stand_in, exposure_s=3.8)
    with pytest.raises(BadValue, match="there is no binning 3"):
        open_camera(stand_in, binning=3)
    open_camera(stand_in).close()


@pytest.mark.parametrize("binning", [1, 2, 4])
@pytest.mark.parametrize("region", [Region(0, 0, 16, 16), Region(496, 480, 16, 32), Region(64, 0, 256, 512), SENSOR])
def test_requested_region_is_read_out(camera: DcamCamera, region: Region, binning: int) -> None:
    camera.set_binning(binning)
    camera.set_region(Region(496, 496, 16, 16))  # the far corner
    assert camera.set_region(region) == camera.region == region
    assert camera.capabilities.rows == region.rows // binning
    assert camera.capabilities.columns == region.columns // binning
    assert camera.capabilities.pixel_pitch_m == pytest.approx(16e-6 * binning)
    camera.start()
    np.testing.assert_array_equal(camera.read(1.0).pixels, pattern(0, region, binning))


@pytest.mark.parametrize(
    "region", [Region(1, 0, 16, 16), Region(0, 0, 20, 16), Region(496, 0, 32, 16), Region(-16, 0, 16, 16)]
)
def test_region_off_sensor_or_step_is_refused(camera: DcamCamera, region: Region) -> None:
    with pytest.raises(BadValue, match="in steps of 16"):
        camera.set_region(region)
    assert camera.region == SENSOR


@pytest.mark.parametrize("failing", [Id.SUBARRAYHSIZE, Id.SUBARRAYVPOS])
def test_region_refused_half_way_is_restored(stand_in: StandIn, camera: DcamCamera, failing: Id) -> None:
    before = camera.set_region(Region(32, 48, 64, 80))
    writes = {Id.SUBARRAYHSIZE: 2, Id.SUBARRAYVPOS: 4}[failing]
    stand_in.fail("dcamprop_setgetvalue", OUTOFRANGE, after=writes)
    with pytest.raises(BadValue, match="subarray"):
        camera.set_region(Region(0, 0, 128, 128))
    assert camera.region == before
    assert (camera.capabilities.rows, camera.capabilities.columns) == (64, 80)


@pytest.mark.parametrize("changed", [Id.SUBARRAYHPOS, Id.SUBARRAYVPOS])
def test_region_step_is_common_multiple(stand_in: StandIn, changed: Id) -> None:
    stand_in.set_step(changed, 24)
    with open_camera(stand_in) as camera:
        assert camera.capabilities.region_step_px == 48  # of 16 and 24
        with pytest.raises(BadValue, match="in steps of 48"):
            camera.set_region(Region(0, 0, 24, 24))
        region = Region(48, 96, 144, 192)
        assert camera.set_region(region) == region


def test_modes_stay_known_while_running(stand_in: StandIn) -> None:
    region = Region(32, 48, 64, 80)
    with open_camera(stand_in, binning=2, region=region, readout_speed=2, trigger="external") as camera:
        camera._properties.set(Id.RECURSIVEFILTER, 2)
        warnings = camera.warnings()
        before = camera.properties()
        camera.start()
        assert (camera.binning, camera.region, camera.readout_speed) == (2, region, 2)
        assert (camera.amplifier, camera.em_gain, camera.trigger) == ("em", 4.0, "external")
        assert camera.warnings() == warnings != ()
        running = camera.properties()
        assert running.keys() == before.keys()
        for name in ("BINNING", "CCD MODE", "SUBARRAY HSIZE", "RECURSIVE FILTER", "warnings"):
            assert running[name] == before[name]


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


def test_refused_value_names_allowed_range(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.refuse(Id.EXPOSURETIME, INVALIDVALUE)
    before_s = camera.exposure_s
    with pytest.raises(BadValue, match=r"exposure time = 0.5, allowed are 0.0139 \.\.\. 1"):
        camera.set_exposure(0.5)
    assert camera.exposure_s == before_s
