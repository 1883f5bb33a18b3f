"""EM gain, properties and warnings of DCAM cameras."""

from __future__ import annotations

import pytest
from support.dcam_tools import open_camera
from support.stand_ins.dcam.stand_in import StandIn

from drivers.dcam._properties import Id
from drivers.dcam.camera import DcamCamera
from drivers.interface import BadValue, DeviceError, Range, Region, Unsupported

SENSOR = Region(0, 0, 512, 512)
EM_PROPERTIES = (0x00400310, 0x00200220, 0x00200250, 0x00200260, 0x00200270, 0x00200290, 0x002002A0, 0x002002B0)


def test_em_gain_is_true_multiplication(camera: DcamCamera) -> None:
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
def test_failed_query_does_not_hide_em_gain(stand_in: StandIn, camera: DcamCamera, code: int) -> None:
    assert camera.em_gain == 4.0
    stand_in.fail("dcamprop_getvalue", code)
    with pytest.raises(Unsupported):
        _ = camera.em_gain
    assert camera.em_gain == 4.0


def test_relative_em_gain_warns(stand_in: StandIn) -> None:
    stand_in.remove(Id.DIRECTEMGAIN_MODE)
    with open_camera(stand_in) as camera:
        assert camera.capabilities.em_gain_range == Range(0.0, 255.0)
        assert any("own scale" in sentence for sentence in camera.warnings())


def test_camera_without_em_gain_works(stand_in: StandIn) -> None:
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


def test_property_lost_with_mode_is_not_queried(stand_in: StandIn, camera: DcamCamera) -> None:
    assert list(camera.capabilities.triggers) == ["internal", "external"]
    stand_in.remove(Id.TRIGGERSOURCE)
    camera.set_binning(2)
    assert list(camera.capabilities.triggers) == ["internal"]
    assert camera.trigger == "internal"


def test_camera_without_pixel_pitch_needs_setting(stand_in: StandIn) -> None:
    stand_in.remove(Id.IMAGEDETECTOR_PIXELWIDTH)
    with pytest.raises(Unsupported, match=r"set camera\.pixel_pitch_m"):
        open_camera(stand_in)
    with open_camera(stand_in, pixel_pitch_m=6.5e-6) as camera:
        assert camera.capabilities.pixel_pitch_m == 6.5e-6


def test_too_much_light_warns_and_black_frames_raise(stand_in: StandIn) -> None:
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


def test_unprotected_camera_keeps_sending_frames(stand_in: StandIn) -> None:
    with open_camera(stand_in, em_gain_protection=False) as camera:
        stand_in.overexpose()
        camera.start()
        for _ in range(10):
            assert camera.read(1.0).pixels.any()


def test_every_readable_property_is_reported(camera: DcamCamera) -> None:
    properties = camera.properties()
    assert properties["exposure_s"] == properties["EXPOSURE TIME"] == 0.0139
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
    assert {name: properties[name] for name in expected} == expected
    assert "STORE SUBTRACT IMAGE TO MEMORY" not in properties  # write-only


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
        (Id.EMCCD_CALIBRATIONMODE, 2, "calibrates its EM gain"),
    ],
)
def test_camera_filters_warn(camera: DcamCamera, identifier: Id, value: float, word: str) -> None:
    assert camera.warnings() == ()
    camera._properties.set(identifier, value)
    (warning,) = camera.warnings()
    assert word in warning
    assert camera.properties()["warnings"] == warning


@pytest.mark.parametrize(
    ("identifier", "harmless", "value", "word"),
    [
        (Id.SENSORMODE, 1, 18, "sensor mode"),
        (Id.OUTPUT_INTENSITY, 1, 2, "test pattern"),
        (Id.OUTPUTDATA_ORIENTATION, 1, 2, "mirrors"),
        (Id.HIGHDYNAMICRANGE_MODE, 1, 2, "dynamic range"),
        (Id.REALTIMEGAINCORRECT_MODE, 1, 2, "gain correction"),
        (Id.DEFECTCORRECT_MODE, 1, 2, "defect correction"),
        (Id.INTENSITY_GAMMA, 1, 0.5, "gamma"),
        (Id.ADVANCEDEDGEENHANCEMENT_MODE, 1, 2, "sharpens"),
    ],
)
def test_modes_of_an_orca_warn(
    camera: DcamCamera, identifier: Id, harmless: float, value: float, word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stand-in has none of them."""
    values, found = camera._properties, harmless
    get_or = values.get_or
    monkeypatch.setattr(values, "get_or", lambda each, default: found if each == identifier else get_or(each, default))
    assert camera.warnings() == ()
    found = value
    (warning,) = camera.warnings()
    assert word in warning


def test_warm_sensor_warns(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.break_cooler()
    (warning,) = camera.warnings()
    assert "cooler reports a fault at 12.5 degC" in warning


def test_em_gain_is_prepared_for_camera_that_hides_it(stand_in: StandIn) -> None:
    stand_in.hide_em_gain()
    with open_camera(stand_in, amplifier="normal") as camera:
        assert "DIRECT EM GAIN MODE" not in camera.properties()
        camera.set_amplifier("em")
        properties = camera.properties()
        assert (properties["DIRECT EM GAIN MODE"], properties["EM GAIN PROTECT MODE"]) == ("ON", "ON")
        camera.set_amplifier("normal")
        assert camera.em_gain == 1.0


def test_unsupported_string_or_attribute_spoils_no_record(stand_in: StandIn, camera: DcamCamera) -> None:
    whole = camera.properties()
    stand_in.fail("dcamdev_getstring", 0x80000808)  # INVALIDPARAM, of the first string
    assert whole.keys() - camera.properties().keys() == {"bus"}
    for function in ("dcamprop_getattr", "dcamprop_getname"):
        stand_in.fail(function, 0x80000F03, after=20)
        (missing,) = whole.keys() - camera.properties().keys()
        assert missing.isupper()
    stand_in.fail("dcamprop_getattr", 0x80000F03, after=1)  # asked whether the first property is an array
    assert camera.properties().keys() == whole.keys()
    stand_in.fail("dcamprop_getvaluetext", 0x80000F03)
    assert camera.properties()["TRIGGER SOURCE"] == 1  # its number


def test_black_frame_is_refused_if_its_cause_cannot_be_read(stand_in: StandIn, camera: DcamCamera) -> None:
    stand_in.overexpose()
    camera.start()
    camera.read(1.0)
    stand_in.fail("dcamprop_getvalue", 0x8000082C, times=2)
    with pytest.raises(DeviceError, match="protects its EM register"):
        camera.read(0.05)
