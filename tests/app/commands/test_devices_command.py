"""`svwfs devices`: the list switches nothing on, and the check detects faulty devices."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.micro_manager_core import FOLDER
from support.simulated_scene import CAMERA, STILL, open_bench
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.pseudo_terminal import PtyServer

from app.acquisition.devices import open_camera, open_light
from app.bench.config import load_bench, write_bench
from app.bench.device_kinds import DRIVERS, KINDS, DeviceKind
from app.commands.device_check import check_and_print, identifying_texts
from app.commands.devices import print_devices
from app.errors import InputError, RunError
from drivers.device import DiscoveredDevice, Property
from drivers.errors import Disconnected, Unsupported
from drivers.genicam import GenicamSettings
from drivers.interface import Camera, LightSource
from drivers.micro_manager import MicroManagerSettings
from drivers.serial_lights import DC4100Settings, thorlabs_dc4100
from simulated_devices.bench import SimulatedBench, SimulatedLight
from simulated_devices.camera import SimulatedCamera

A_CAMERA = DiscoveredDevice(kind="camera", driver="dcam", description="C9100-23B S/N 1", settings={"device": "S/N 1"})
A_LIGHT = DiscoveredDevice(
    kind="light",
    driver="coolled",
    description="CoolLED",
    settings={"port": "COM7"},
    is_certain=False,
    missing="a cable",
)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimulatedBench:
    """A bench whose simulated devices are discovered as real ones."""
    bench = open_bench(tmp_path, replace(STILL, object_samples=3), CAMERA)

    def discover(kind: DeviceKind) -> Any:
        return {"dcam": (A_CAMERA,), "coolled": (A_LIGHT,)}.get(kind.driver, ())

    monkeypatch.setattr("app.bench.device_kinds.import_module", lambda module: _Module(module, discover))
    monkeypatch.setattr("app.commands.device_check.open_camera", lambda settings: SimulatedCamera(bench))
    monkeypatch.setattr(
        "app.commands.device_check.open_light", lambda settings: SimulatedLight(bench, limit_a=settings.limit_a)
    )
    return bench


class _Module:
    def __init__(self, module: str, discover: Callable[[DeviceKind], Any]) -> None:
        self.discover = lambda: discover(next(kind for kind in KINDS if kind.device.startswith(f"{module}.")))


def test_devices_lists_bench_sections(bench: SimulatedBench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.change(is_light_on=False)
    print_devices()
    output = capsys.readouterr().out
    assert 'dcam:S/N 1   C9100-23B S/N 1\n      [camera]\n      driver = "dcam"\n      device = "S/N 1"\n' in output
    assert "coolled:COM7   perhaps a CoolLED\n    cannot be used yet: a cable\n" in output
    assert output.count("none found") == len(KINDS) - 2  # dcam and coolled
    assert not bench.condition.is_light_on


def test_failed_search_reports_reason(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise Unsupported("the library is missing: install it")

    monkeypatch.setattr(
        "app.bench.device_kinds.import_module", lambda _: type("Module", (), {"discover": staticmethod(fail)})
    )
    print_devices()
    assert capsys.readouterr().out.count("  not searched: the library is missing: install it\n") == len(KINDS)


def test_every_searched_driver_exists_in_bench_and_has_a_name() -> None:
    for kind in KINDS:
        assert kind.name
        assert all(device.driver == kind.driver for device in kind.discover()[0])
    real = {*DRIVERS["camera"], *DRIVERS["light"]} - {"simulated", "recording", "manual"}
    assert real == {kind.driver for kind in KINDS}
    bench = load_bench("live_demo")
    with pytest.raises(InputError, match="has no device"):
        open_camera(bench.camera)
    with pytest.raises(InputError, match="has no device"):
        open_light(bench.light)


@pytest.mark.usefixtures("bench")
def test_good_camera_passes(capsys: pytest.CaptureFixture[str]) -> None:
    check_and_print("dcam:S/N 1")
    output = capsys.readouterr().out
    assert "Simulated C9100-23B" in output
    assert "dcam:(serial number) passes all 15 checks" in output
    assert "FAILED" not in output
    assert len(re.findall(r"^  ok +\d+\.\d\d s  \w", output, re.MULTILINE)) == 15
    assert re.search(r"^opened in \d+\.\d\d s$", output, re.MULTILINE)


@pytest.fixture
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver waits a minute for an answer, because the thread of a stand-in may be late."""
    monkeypatch.setattr(thorlabs_dc4100, "_DIALECT", replace(thorlabs_dc4100._DIALECT, timeout_s=60.0))


@pytest.mark.posix
@pytest.mark.slow
@pytest.mark.usefixtures("patience")
@pytest.mark.parametrize("shows", [False, True])
def test_serial_numbers_are_hidden_unless_asked_for(capsys: pytest.CaptureFixture[str], *, shows: bool) -> None:
    lamp = DC4100Wire()
    with PtyServer(lamp) as server:
        light = DC4100Settings(port=server.port, channel=1)
        bench = replace(load_bench("live_demo"), camera=GenicamSettings(), light=light)
        check_and_print("light", bench, serial_numbers=shows)
        with pytest.raises(InputError, match="--check takes camera or light"):
            check_and_print("thorlabs_dc4100", bench)
    output = capsys.readouterr().out
    assert ("M00266001" in output) == shows
    assert ("DC4100 (serial number) LED2" in output) == (not shows)
    assert "channel = 1" in output
    assert "lowest_current_a = 0.0" in output


@pytest.mark.usefixtures("bench")
def test_lost_light_hides_its_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def lose(_: object) -> Camera:
        raise Disconnected(f"the camera S/N 1 is gone; see {Path.home()}/log")

    monkeypatch.setattr("app.commands.device_check.open_camera", lose)
    with pytest.raises(RunError, match=r"^the camera \(serial number\) is gone; see ~/log$"):
        check_and_print("dcam:S/N 1")


def test_only_serial_numbers_count_as_such() -> None:
    properties: dict[str, Property] = {
        "serial number": "21735912",
        "CameraID": "A1",
        "DeviceUserID": "bench of Ann",
        "head": "Thorlabs,M455L4,M00412345,1.0.0",
        "firmware": "1.2.0",
        "Exposure": "10000.0000",
        "CCD": 65536,
        "model": "C9100-23B",
    }
    found = identifying_texts("Hamamatsu C9100-23B, serial 000123", {"device": "0", "exposure_s": 0.01}, properties)
    assert found == {"21735912", "bench of Ann", "M00412345", "000123"}
    assert identifying_texts("", {"device": "S/N 1"}, {}) == {"S/N 1"}
    assert not identifying_texts("", {"adapter": "DemoCamera", "device": "DCam"}, {})  # a model


def test_good_light_passes_within_announced_current(
    bench: SimulatedBench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    brightest_a: list[float] = []
    change = bench.change

    def watch(**changes: Any) -> None:
        change(**changes)
        if bench.condition.is_light_on:
            brightest_a.append(bench.condition.current_a)

    monkeypatch.setattr(bench, "change", watch)
    check_and_print("coolled:COM7")
    output = capsys.readouterr()
    assert "passes all 5 checks" in output.out
    assert output.err == "the light will shine with up to 50 mA, 5% of its range\n"
    assert max(brightest_a) == pytest.approx(0.05)
    assert not bench.condition.is_light_on


def test_camera_behind_micro_manager_is_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = {"OnCameraCCDXSize": "64", "OnCameraCCDYSize": "48", "MaximumExposureMs": "500"}
    camera = MicroManagerSettings(
        adapter="DemoCamera",
        device="DCam",
        adapter_folder=FOLDER,
        properties={"PixelType": "16bit", "FastImage": "1"} | small,
    )
    written = tmp_path / "bench.toml"
    written.write_text(write_bench(replace(load_bench("live_demo"), camera=camera, light=DC4100Settings(port="none"))))
    bench = load_bench(str(written))
    assert bench.camera == camera
    check_and_print("camera", bench)
    assert "camera passes all 15 checks" in capsys.readouterr().out


@pytest.mark.usefixtures("bench")
def test_contract_breaking_camera_fails(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        SimulatedCamera, "_set_em_gain", lambda self, em_gain: em_gain
    )  # acknowledges without setting it
    with pytest.raises(RunError, match=r"dcam:\(serial number\) fails 1 of 15 checks"):
        check_and_print("dcam:S/N 1")
    output = capsys.readouterr().out
    assert re.search(r"  FAILED +\d\.\d\d s  It accepts gains in its range; a refused one changes nothing\n", output)
    assert re.search(r"\n +a gain of [\d.]+ is in force, not [\d.]+ as it returned\n", output)


def test_lost_light_ends_check(bench: SimulatedBench, monkeypatch: pytest.MonkeyPatch) -> None:
    def lose(_: LightSource, *, on: bool) -> None:
        if on:
            raise Disconnected("the light is gone")
        bench.change(is_light_on=False)

    monkeypatch.setattr(SimulatedLight, "_switch", lose)
    with pytest.raises(RunError, match="the light is gone"):
        check_and_print("coolled:COM7")


@pytest.mark.usefixtures("bench")
def test_unconnected_device_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RunError, match=r"dcam:2 is not connected; `svwfs devices` shows what is"):
        check_and_print("dcam:2")
    with pytest.raises(InputError, match="--check camera needs --bench"):
        check_and_print("camera")
    with pytest.raises(InputError, match="it begins with one of dcam, genicam"):
        check_and_print("/dev/ttyUSB0")

    def fail(_: object) -> Camera:
        raise Unsupported("no library")

    monkeypatch.setattr("app.commands.device_check.open_camera", fail)
    with pytest.raises(RunError, match="no library"):
        check_and_print("dcam:S/N 1")
