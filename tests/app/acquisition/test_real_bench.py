"""A real bench from its TOML: DCAM camera and DC4100 light, each driver with its stand-in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from support.dcam_tools import built, dcam_stand_in
from support.paths import FOREIGN_FRAMES
from support.patience import HANG_S, own_time, wait_until
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.dcam.stand_in import StandIn
from support.stand_ins.pseudo_terminal import PtyServer

from app.acquisition.devices import open_camera, open_devices, open_light
from app.acquisition.instrument import Instrument
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, parse_bench, write_bench
from app.errors import InputError
from app.recording.reader import Recording
from drivers.dcam import DcamSettings
from drivers.errors import DeviceError, Disconnected
from drivers.serial_lights import DC4100Settings
from drivers.serial_lights.thorlabs_dc4100 import _DIALECT

FOREIGN = (FOREIGN_FRAMES / "bench.toml").read_text()
WITHIN_S = 2.0
REAL_TIME = 1.0


@pytest.fixture
def camera() -> Iterator[StandIn]:
    with dcam_stand_in(REAL_TIME) as stand_in:
        yield stand_in


@pytest.fixture
def port(lamp_port: PtyServer, monkeypatch: pytest.MonkeyPatch) -> PtyServer:
    """A port whose stand-in may answer late."""
    monkeypatch.setattr("drivers.serial_lights.thorlabs_dc4100._DIALECT", replace(_DIALECT, timeout_s=HANG_S))
    return lamp_port


@pytest.fixture
def bench(camera: StandIn, port: PtyServer) -> Bench:
    assert camera.library == built()
    text = f"""
[camera]
driver = "dcam"
library = '{built()}'
exposure_s = 0.02
ring_frames = 1000

[light]
driver = "thorlabs_dc4100"
port = "{port.port}"
current_a = 0.1
limit_a = 0.15
"""
    return parse_bench(FOREIGN + text, "real.toml")


def started(bench: Bench) -> Acquisition:
    acquisition = Acquisition(bench, open_devices)
    acquisition.start()
    for step in start_up(acquisition, frames=3):
        step.result(HANG_S)
    return acquisition


def test_bench_file_opens_real_devices(bench: Bench, lamp: DC4100Wire) -> None:
    with open_devices(bench, lambda _: None) as devices:
        assert "C9100-23B" in devices.camera.name
        assert "DC4100" in devices.light.name
        assert devices.camera.exposure_s == pytest.approx(0.02)
        assert (devices.light.current_a, devices.light.current_range_a.maximum) == (0.1, 0.15)
        assert (devices.stage.masks, devices.stage.is_sample_in) == (("square",), False)
        assert not lamp.is_lit
        devices.light.set_on(True)
        assert lamp.is_lit
    assert not lamp.is_lit


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("sensor.pixel_pitch_m=15.5e-6", r"sensor\.pixel_pitch_m = 1\.55e-05, but .* reports 1\.6e-05"),
        ("camera.exposure_s=2.0", r"camera: .*outside 0\.0139"),
        ("light.current_a=0.2", r"light: current_a = 0\.2 is outside 0 \.\.\. 0\.15"),
    ],
)
def test_settings_refused_by_device_are_input_error(bench: Bench, lamp: DC4100Wire, change: str, sentence: str) -> None:
    wrong = parse_bench(write_bench(bench), "real.toml", (change,))
    with pytest.raises(InputError, match=sentence):
        open_devices(wrong, lambda _: None)
    assert not lamp.is_lit
    open_devices(bench, lambda _: None).close()  # everything was closed


def test_settings_that_come_from_no_bench_are_checked_before_a_device_is_opened() -> None:
    with pytest.raises(InputError, match=r"^camera\.binning must be 1 \.\.\. 16$"):
        open_camera(DcamSettings(binning=0))
    with pytest.raises(InputError, match=r"^light\.port must be given"):
        open_light(DC4100Settings())


def test_missing_light_closes_camera(bench: Bench, port: PtyServer) -> None:
    port.close()
    with pytest.raises(DeviceError, match=port.port):
        open_devices(bench, lambda _: None)


def test_silence_of_the_worker_switches_the_light_off_and_the_status_says_so(bench: Bench, lamp: DC4100Wire) -> None:
    """As a call of the camera that hangs; the acquisition goes on, and the light can be lit again."""
    acquisition = started(bench)

    def hang(instrument: Instrument) -> None:
        instrument.devices.light.keep_alive(0.3)
        wait_until(lambda: not lamp.is_lit)

    acquisition.commands.submit(hang).result(HANG_S)
    why = "the light went off because the acquisition gave no sign of life for 0.3 s"
    wait_until(lambda: acquisition.status is not None and acquisition.status.warning == why)
    assert acquisition.status is not None
    assert not acquisition.status.is_light_on
    acquisition.set_light_on(True).result(HANG_S)
    assert lamp.is_lit
    assert acquisition.status.warning != why
    acquisition.close()
    assert acquisition.failure == ""


def test_unplugged_camera_ends_recording_that_stays_readable(
    bench: Bench, camera: StandIn, lamp: DC4100Wire, tmp_path: Path
) -> None:
    acquisition = started(bench)
    assert lamp.is_lit
    acquisition.start_recording(tmp_path / "r", command="test").result(HANG_S)
    wait_until(lambda: (acquisition.recording is not None) and acquisition.recording.frames >= 5)
    with own_time() as elapsed_s:
        camera.unplug()
        wait_until(lambda: not acquisition.is_alive)
        assert elapsed_s() < WITHIN_S + 1  # the recording may take a second to finish
    assert isinstance(acquisition.error, Disconnected)
    assert not lamp.is_lit
    recording = Recording(tmp_path / "r")
    assert recording.is_complete
    assert len(recording) >= 5
    indexes = [recording.line(i).camera_index for i in range(len(recording))]
    assert indexes == list(range(indexes[0], indexes[0] + len(indexes)))

    camera.plug_in()
    again = started(bench)
    wait_until(lambda: again.newest is not None and again.counts.acquired > 0)
    again.close()
    assert again.error is None
    assert not lamp.is_lit


@pytest.mark.parametrize("exposure_s", [0.03, 60.0])
def test_unplugged_light_ends_measuring(bench: Bench, port: PtyServer, exposure_s: float) -> None:
    """Also during a long exposure."""
    slow = parse_bench(write_bench(bench), "real.toml", ("camera.readout_speed=2", "camera.exposure_s=0.03"))
    acquisition = started(slow)
    exposure = acquisition.commands.submit(lambda instrument: instrument.devices.camera.set_exposure(exposure_s))
    assert exposure.result(HANG_S) == pytest.approx(exposure_s, rel=0.01)
    with own_time() as elapsed_s:
        port.unplug()
        wait_until(lambda: not acquisition.is_alive)
        assert elapsed_s() < WITHIN_S
    assert isinstance(acquisition.error, Disconnected)
    assert "is gone" in acquisition.failure
    assert "may still be on: switch it off by hand" in acquisition.failure
