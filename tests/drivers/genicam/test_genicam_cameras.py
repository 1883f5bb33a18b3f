"""GenICam driver with the features of real cameras: descriptions with odd, missing, locked and leftover ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final

import numpy as np
import pytest
from genicam_descriptions import PFNC, Description
from genicam_models import (
    COLUMNS,
    MODELS,
    ON_OFF,
    ROWS,
    Model,
    blackfly,
    dhyana,
    grasshopper3,
    left_aligned,
    manta,
    pco1600,
    ramp,
    scientific_cmos,
    switched_on,
    usual,
)
from gige_camera import ADDRESS, GigeCamera

from drivers.camera import Region
from drivers.contract.camera import (
    check_exposures,
    check_frames,
    check_identity,
    check_modes,
    check_region,
    check_settings_are_allowed,
)
from drivers.errors import DeviceError, Unsupported
from drivers.genicam import GenicamSettings
from drivers.genicam._library import load_aravis
from drivers.genicam.camera import GenicamCamera

try:
    load_aravis()
except Unsupported as error:
    pytest.skip(f"the extra genicam is not installed: {error}", allow_module_level=True)

SETTINGS: Final = GenicamSettings(device=ADDRESS, packet_size=1400, exposure_s=0.004)


@pytest.fixture
def peer() -> Iterator[Callable[[Model], GigeCamera]]:
    """Switch on a camera."""
    running: list[GigeCamera] = []

    def switch_on(model: Model) -> GigeCamera:
        running.append(switched_on(model).__enter__())
        return running[-1]

    yield switch_on
    for camera in running:
        camera.__exit__()


@pytest.mark.parametrize("make", MODELS)
def test_model_keeps_the_contract(make: Callable[[], Model], peer: Callable[[Model], GigeCamera]) -> None:
    model = make()
    peer(model)
    with GenicamCamera(SETTINGS) as camera:
        for check in (check_identity, check_frames, check_region, check_modes, check_exposures):
            check(camera)
        properties = camera.properties()
        for feature, value in {"ExposureMode": "Timed", "ExposureAuto": "Off", "Gamma": "1"}.items():
            assert properties[feature] == value
        for feature in ("LUTEnable", "ReverseX", "ReverseY"):
            assert properties[feature] == "false"
        for feature in ("DecimationHorizontal", "DecimationVertical"):
            assert properties[feature] == "1"
        check_settings_are_allowed(camera)


@pytest.mark.parametrize(
    ("make", "name", "full_scale"),
    [
        (grasshopper3, "Mono16", 65520),
        (blackfly, "Mono16", 65520),
        (manta, "Mono12", 4095),
        (manta, "Mono12Packed", 4095),
        (dhyana, "Mono12", 4095),
        (scientific_cmos, "Mono12", 4095),
        (pco1600, "Mono12", 4095),
    ],
)
def test_saturated_pixels_arrive_at_full_scale(
    make: Callable[[], Model], name: str, full_scale: int, peer: Callable[[Model], GigeCamera]
) -> None:
    model = make()
    peer(model)
    with GenicamCamera(replace(SETTINGS, pixel_format=name)) as camera:
        camera.start()
        pixels = camera.read(5.0).pixels
        expected = (model.pixels or ramp)(ROWS, COLUMNS)
        np.testing.assert_array_equal(pixels, expected)
        assert camera.capabilities.full_scale == pixels.max() == full_scale
        assert camera.properties()["full_scale"] == full_scale


@pytest.mark.parametrize(
    ("make", "name"),
    [(grasshopper3, "Mono12p"), (blackfly, "Mono12Packed"), (manta, "Mono12"), (dhyana, "Mono12"), (pco1600, "Mono12")],
)
def test_unpadded_format_is_chosen(make: Callable[[], Model], name: str, peer: Callable[[Model], GigeCamera]) -> None:
    peer(make())
    with GenicamCamera(SETTINGS) as camera:
        assert camera.properties()["pixel_format"] == name
        assert camera.capabilities.full_scale == 4095


@pytest.mark.parametrize(
    ("feature", "depths", "asked", "name", "depth"),
    [
        ("AdcBitDepth", ("Bit8", "Bit10", "Bit12"), "", "Mono12p", "Bit12"),
        ("AdcBitDepth", ("Bit8", "Bit10", "Bit12"), "Mono8", "Mono8", "Bit8"),
        ("AdcBitDepth", ("Bit8", "Bit10"), "", "Mono10p", "Bit10"),
        ("SensorBitDepth", ("Adaptive", "Bpp8", "Bpp12"), "", "Mono12p", "Bpp12"),
        ("SensorBitDepth", ("Adaptive",), "", "Mono12p", "Adaptive"),
        ("BslSensorBitDepth", ("Bpp12", "Bpp10"), "Mono10p", "Mono10p", "Bpp10"),
    ],
)
def test_digitiser_suits_the_format(
    feature: str, depths: tuple[str, ...], asked: str, name: str, depth: str, peer: Callable[[Model], GigeCamera]
) -> None:
    of = usual(("Mono8", "Mono16", "Mono10p", "Mono12p"))
    of.number("ExposureTime", 9000, 10, 1e6)
    of.enumeration(feature, depths[0], {depth: i for i, depth in enumerate(depths)})
    peer(Model("Maker", "Model", of))
    with GenicamCamera(replace(SETTINGS, pixel_format=asked)) as camera:
        properties = camera.properties()
        assert (properties["pixel_format"], properties[feature]) == (name, depth)


def test_digitiser_that_follows_the_format_keeps_all_bits(peer: Callable[[Model], GigeCamera]) -> None:
    """Basler ace 2 as delivered: Mono8, and a locked depth that follows the pixel format."""
    of = usual(("Mono8", "Mono10", "Mono12"))
    of.number("ExposureTime", 9000, 10, 1e6)
    locked = "<ImposedAccessMode>RO</ImposedAccessMode>"
    of.enumeration("BslSensorBitDepth", "Bpp10", {"Bpp10": 10, "Bpp12": 12}, more=locked)

    def follow(camera: GigeCamera, of: Description) -> None:
        is_deep = camera.register(of.addresses["PixelFormat"]) == PFNC["Mono12"]
        camera.set_register(of.addresses["BslSensorBitDepth"], 12 if is_deep else 10)

    peer(Model("Basler", "a2A2600-20gmBAS", of, after_write=follow))
    with GenicamCamera(SETTINGS) as camera:
        properties = camera.properties()
        assert (properties["pixel_format"], properties["BslSensorBitDepth"]) == ("Mono12", "Bpp12")


@pytest.mark.parametrize(("depth", "name"), [("Bit10", "Mono10p"), ("Bit12", "Mono12p")])
def test_format_suits_a_fixed_digitiser(depth: str, name: str, peer: Callable[[Model], GigeCamera]) -> None:
    of = usual(("Mono8", "Mono16", "Mono10p", "Mono12p"))
    of.number("ExposureTime", 9000, 10, 1e6)
    of.enumeration("AdcBitDepth", depth, {"Bit10": 0, "Bit12": 1}, more="<ImposedAccessMode>RO</ImposedAccessMode>")
    peer(Model("Maker", "Model", of))
    with GenicamCamera(SETTINGS) as camera:
        assert camera.properties()["pixel_format"] == name


def test_reported_byte_order_counts(peer: Callable[[Model], GigeCamera]) -> None:
    of = usual(("Mono16",))
    of.number("ExposureTime", 9000, 10, 1e6)
    of.boolean("GevSCPSBigEndian", 1, more="<ImposedAccessMode>RO</ImposedAccessMode>")
    peer(Model("Maker", "Model", of, left_aligned, ">"))
    with GenicamCamera(SETTINGS) as camera:
        camera.start()
        np.testing.assert_array_equal(camera.read(5.0).pixels, left_aligned(ROWS, COLUMNS))


def test_full_scale_and_byte_order_can_be_given(peer: Callable[[Model], GigeCamera]) -> None:
    peer(blackfly())
    with GenicamCamera(replace(SETTINGS, pixel_format="Mono16", full_scale=4095, byte_order="little")) as camera:
        assert camera.capabilities.full_scale == 4095
        camera.start()
        np.testing.assert_array_equal(camera.read(5.0).pixels, left_aligned(ROWS, COLUMNS).byteswap())
        assert camera.capabilities.full_scale == 4095


def test_locked_binning_follows_the_other_axis(peer: Callable[[Model], GigeCamera]) -> None:
    model = grasshopper3()
    camera_peer = peer(model)
    camera_peer.locked = frozenset({model.description.addresses["BinningHorizontal"]})
    with GenicamCamera(SETTINGS) as camera:
        assert camera.capabilities.binnings == (1, 2)
        camera.set_binning(2)
        assert camera.binning == 2
        assert (camera.capabilities.rows, camera.capabilities.columns) == (ROWS // 2, COLUMNS // 2)
    assert camera_peer.refused == []


def test_leftover_frame_rate_is_released(peer: Callable[[Model], GigeCamera]) -> None:
    peer(grasshopper3())
    with GenicamCamera(SETTINGS) as camera:
        properties = camera.properties()
        assert properties["AcquisitionFrameRateEnabled"] == "false"
        assert (properties["GammaEnabled"], properties["SharpnessEnabled"]) == ("false", "false")
    with GenicamCamera(replace(SETTINGS, frame_rate_hz=20.0)) as camera:
        assert camera.properties()["AcquisitionFrameRateEnabled"] == "true"
        assert camera.properties()["frame_rate_hz"] == 20
        camera.set_trigger("Line0")
        assert camera.properties()["AcquisitionFrameRateEnabled"] == "false"


def test_leftover_processing_is_switched_off_and_recorded(peer: Callable[[Model], GigeCamera]) -> None:
    of = usual(("Mono12",))
    of.number("ExposureTime", 9000, 10, 1e6)
    modes = ("SequencerMode", "BlackLevelAuto", "ImageCompressionMode", "HDRMode", "BslDefectPixelCorrectionMode")
    switches = ("SharpeningEnable", "DefectCorrectStaticEnable", "IspEnable", "NoiseReductionEnable", "HDREnable")
    numbers = {"DigitalShift": "0", "Sharpness": "0", "SharpnessEnhancement": "1", "BslSharpnessEnhancement": "1"}
    for name in modes:
        of.enumeration(name, "On", ON_OFF)
    of.enumeration("TestPattern", "Ramp", {"Off": 0, "Ramp": 1})
    for name in switches:
        of.boolean(name, 1)
    for name in numbers:
        of.integer(name, 3, 0, 4)
    peer(Model("Maker", "Model", of))
    expected = dict.fromkeys((*modes, "TestPattern"), "Off") | dict.fromkeys(switches, "false") | numbers
    with GenicamCamera(SETTINGS) as camera:
        properties = camera.properties()
        assert {name: properties[name] for name in expected} == expected


def test_frames_without_timestamp_have_the_host_time(
    peer: Callable[[Model], GigeCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Lucid Atlas cameras send them."""
    peer(pco1600())
    with GenicamCamera(SETTINGS) as camera:
        call = camera._aravis.call
        monkeypatch.setattr(
            camera._aravis,
            "call",
            lambda name, *arguments: 0 if name == "arv_buffer_get_timestamp" else call(name, *arguments),
        )
        camera.start()
        frame = camera.read(5.0)
        assert frame.camera_time_s == frame.host_time_s > 0


def test_odd_nodes_do_not_spoil_the_properties(peer: Callable[[Model], GigeCamera]) -> None:
    model = dhyana()
    of = model.description.addresses
    camera_peer = peer(model)
    camera_peer.unreadable = frozenset({of["DeviceTemperature"], of["ReverseY"]})
    with GenicamCamera(SETTINGS) as camera:
        properties = camera.properties()
        assert properties["BlackLevel"] == 100
        assert "DeviceTemperature" not in properties
        assert "ReverseY" not in properties
        assert "GammaEnable" not in properties
        assert "SharpnessEnabled" not in properties


def test_black_level_category_is_left_out(peer: Callable[[Model], GigeCamera]) -> None:
    peer(manta())
    with GenicamCamera(SETTINGS) as camera:
        assert "BlackLevel" not in camera.properties()
        assert camera.properties()["SensorBits"] == "12"


def test_camera_without_offsets_reads_out_its_whole_sensor(peer: Callable[[Model], GigeCamera]) -> None:
    peer(scientific_cmos())
    with GenicamCamera(SETTINGS) as camera:
        assert camera.capabilities.sensor is None
        assert camera.region == Region(0, 0, ROWS, COLUMNS)
        with pytest.raises(Unsupported):
            camera.set_region(Region(0, 0, 16, 16))
    with pytest.raises(Unsupported, match="whole sensor"):
        GenicamCamera(replace(SETTINGS, region=Region(0, 0, 16, 16)))


def test_whole_region_keeps_to_the_steps_with_binning(peer: Callable[[Model], GigeCamera]) -> None:
    """With a binning of 2 a side of 2064 pixels would be 1032, no multiple of 16."""
    of = usual(("Mono8",), step=16)
    of.number("ExposureTime", 9000, 10, 1e6)
    for side in ("SensorWidth", "WidthMax", "Width"):
        of.values[side] = 2064
    of.integer("BinningVertical", 1, 1, 4)
    of.integer("BinningHorizontal", 1, 1, 4)

    def shrink(camera: GigeCamera, of: Description) -> None:
        binning = camera.register(of.addresses["BinningHorizontal"])
        camera.set_register(of.addresses["WidthMax"], 2064 // binning)

    camera_peer = peer(Model("Basler", "acA2040-35gm", of, after_write=shrink))
    with GenicamCamera(SETTINGS) as camera:
        assert camera.capabilities.sensor == Region(0, 0, ROWS, 2064)
        camera.set_binning(2)
        sensor = camera.capabilities.sensor
        assert sensor == Region(0, 0, 32, 2048)
        assert camera.set_region(sensor) == sensor
        assert camera_peer.register(of.addresses["Width"]) == 1024


def test_leftover_binning_is_reset(peer: Callable[[Model], GigeCamera]) -> None:
    of = usual(("Mono8",))
    of.number("ExposureTime", 9000, 10, 1e6)
    of.integer("BinningVertical", 1, 1, 4)
    of.integer("BinningHorizontal", 2, 1, 4)
    peer(Model("Maker", "Model", of))
    with GenicamCamera(SETTINGS) as camera:
        assert camera.binning == 1
        assert camera.capabilities.binnings == (1, 2, 3, 4)


def test_binning_without_factor_is_switched_off(peer: Callable[[Model], GigeCamera]) -> None:
    of = usual(("Mono8",))
    of.number("ExposureTime", 9000, 10, 1e6)
    for axis in ("BinningVertical", "BinningHorizontal"):
        of.enumeration(axis, "On", ON_OFF)
    camera_peer = peer(Model("SVS-VISTEK", "evo4050", of))
    with GenicamCamera(SETTINGS) as camera:
        assert camera.capabilities.binnings == (1,)
        assert camera_peer.register(of.addresses["BinningVertical"]) == 0
        camera.set_binning(1)


def test_unequal_binning_is_refused(peer: Callable[[Model], GigeCamera]) -> None:
    of = usual(("Mono8",))
    of.number("ExposureTime", 9000, 10, 1e6)
    of.integer("BinningVertical", 1, 1, 4)
    of.integer("BinningHorizontal", 2, 1, 4, more="<ImposedAccessMode>RO</ImposedAccessMode>")
    peer(Model("Maker", "Model", of))
    with pytest.raises(Unsupported, match="bins 1 rows and 2 columns: square pixels are needed"):
        GenicamCamera(SETTINGS)


def test_camera_without_exposure_time_is_refused(peer: Callable[[Model], GigeCamera]) -> None:
    peer(Model("FLIR", "SC6700", usual(("Mono16",))))
    with pytest.raises(Unsupported, match="offers no exposure time"):
        GenicamCamera(SETTINGS)


def test_too_small_payload_is_refused(peer: Callable[[Model], GigeCamera]) -> None:
    camera_peer = peer(pco1600())
    with GenicamCamera(SETTINGS) as camera:
        camera_peer.after_write = lambda _camera: None
        camera_peer.set_register(pco1600().description.addresses["PayloadSize"], 100)
        with pytest.raises(DeviceError, match="sends 100 bytes per frame instead of 9216 or more"):
            camera.start()
