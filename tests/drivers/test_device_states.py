"""Device states (open, lost, closed) and defaults of the base classes, without a driver."""

from __future__ import annotations

from dataclasses import replace

import pytest

from drivers.interface import (
    BadValue,
    Busy,
    Camera,
    CameraCapabilities,
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


class PlainCamera(Camera):
    """Minimal driver: one mode, no frames."""

    name = "plain"

    def __init__(self) -> None:
        super().__init__()
        self.fault: DeviceError | None = None
        self.times_closed = 0

    def raise_fault(self) -> None:
        if self.fault is not None:
            raise self.fault

    def _read_capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(
            rows=4,
            columns=6,
            pixel_pitch_m=1e-6,
            full_scale=255,
            exposure_range_s=Range(1.0, 2.0),
            em_gain_range=Range(1.0, 1.0),
            amplifiers=("normal",),
        )

    def _is_running(self) -> bool:
        self.raise_fault()
        return False

    def _start(self) -> None:
        self.raise_fault()

    def _stop(self) -> None:
        self.raise_fault()

    def _read(self, timeout_s: float) -> Frame:
        raise DeviceTimeout(f"{timeout_s}")

    def _read_exposure(self) -> float:
        self.raise_fault()
        return 1.0

    def _set_exposure(self, exposure_s: float) -> float:
        return exposure_s

    def _close(self) -> None:
        self.times_closed += 1
        self.raise_fault()


def test_optional_settings_default_to_one_choice() -> None:
    camera = PlainCamera()
    assert (camera.amplifier, camera.readout_speed, camera.binning, camera.trigger) == ("normal", 1, 1, "internal")
    assert (camera.em_gain, camera.set_em_gain(1.0)) == (1.0, 1.0)
    assert camera.region == Region(0, 0, 4, 6)
    assert camera.properties()["region"] == "4 x 6 at row 0, column 0"
    with pytest.raises(Unsupported, match="whole sensor"):
        camera.set_region(camera.region)
    with pytest.raises(BadValue, match="there is no binning 2; there are 1"):
        camera.set_binning(2)


def test_loss_is_remembered_with_its_message() -> None:
    camera = PlainCamera()
    camera.fault = Disconnected("the cable is out")
    with pytest.raises(Disconnected):
        _ = camera.exposure_s
    camera.fault = None
    assert camera.state == "lost"
    with pytest.raises(Disconnected, match=r"^the cable is out$"):
        _ = camera.exposure_s


def test_lost_device_closes_silently() -> None:
    camera = PlainCamera()
    camera.fault = Disconnected("the cable is out")
    assert camera.state == "lost"
    camera.close()
    camera.close()
    assert (camera.times_closed, camera.state) == (1, "closed")


@pytest.mark.parametrize("kind", [Busy, DeviceTimeout, FrameLost, Unsupported, WrongState, BadValue, DeviceError])
def test_other_faults_leave_device_connected(kind: type[DeviceError]) -> None:
    camera = PlainCamera()
    camera.fault = kind("no")
    with pytest.raises(kind, match=r"^no$"):
        _ = camera.exposure_s
    camera.fault = None
    assert camera.state == "stopped"
    assert camera.exposure_s == 1.0


def test_failed_close_raises_and_closes() -> None:
    camera = PlainCamera()
    camera.fault = DeviceTimeout("no answer")
    with pytest.raises(DeviceTimeout):
        camera.close()
    assert camera.state == "closed"
    camera.close()


def test_with_block_closes() -> None:
    with pytest.raises(ZeroDivisionError), PlainCamera() as camera:
        raise ZeroDivisionError
    assert camera.state == "closed"


@pytest.mark.parametrize(
    "region",
    [
        Region(0, 0, 5, 16),
        Region(8, 0, 16, 16),
        Region(0, 0, 48, 16),
        Region(-16, 0, 16, 16),
        Region(0, 32, 16, 32),
        Region(0, 0, 0, 16),
    ],
)
def test_region_must_lie_on_sensor_in_steps(region: Region) -> None:
    class Parts(PlainCamera):
        def _read_capabilities(self) -> CameraCapabilities:
            plain = super()._read_capabilities()
            return replace(plain, rows=40, columns=50, sensor=Region(0, 0, 40, 50), region_step_px=16)

    camera = Parts()
    with pytest.raises(BadValue, match="does not lie on the sensor of 40 x 50 in steps of 16"):
        camera.set_region(region)
    for allowed in (Region(0, 0, 40, 50), Region(16, 32, 16, 16)):  # the whole sensor may break the steps
        assert camera.set_region(allowed) == allowed
