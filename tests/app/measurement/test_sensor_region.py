"""Sensor areas: regions in steps, binning, and the lattice at its place on the sensor."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.dcam_tools import dcam_stand_in, open_camera
from support.gui_bench import BENCH, FakeCamera, opener
from support.optics import sensor_of
from support.patience import HANG_S, wait_until
from support.stand_ins.dcam.stand_in import pattern

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench, parse_bench, write_bench
from app.measurement.measurement import Measurement
from app.measurement.sensor_region import (
    SensorArea,
    in_steps,
    lenslets_outside,
    moved_bench,
    moved_lattice,
    region_around,
    set_area,
)
from app.recording.reader import Recording
from drivers.dcam import DcamSettings
from drivers.interface import BadValue, CameraCapabilities, Region, WrongState
from drivers.serial_lights import CoolLEDSettings
from reconstruction.geometry import Lattice
from simulated_devices.settings import SimulatedCameraSettings

SENSOR = Region(0, 0, 500, 700)
LATTICE = Lattice(center_x_px=121.3, center_y_px=84.6, pitch_px=31.25, rotation_rad=0.003)
LENSLETS = sensor_of(5, 7)
regions = st.builds(Region, *[st.integers(-50, 750)] * 2, *[st.integers(1, 900)] * 2)


@given(regions, st.sampled_from([1, 2, 4, 7, 16, 128]))
@example(Region(-40, 20, 10, 30), 16)  # above the sensor
@example(Region(20, 740, 10, 30), 16)  # beside it
def test_regions_grow_to_whole_steps_on_sensor(region: Region, step_px: int) -> None:
    got = in_steps(region, SENSOR, step_px)
    if got != SENSOR:
        assert not any(number % step_px for number in (got.top, got.left, got.rows, got.columns))
    ends = (got.top + got.rows, got.left + got.columns)
    assert min(got.top, got.left) >= 0 < min(got.rows, got.columns)
    assert ends[0] <= SENSOR.rows
    assert ends[1] <= SENSOR.columns
    # Only pixels beyond the last whole step may be lost.
    for first, length, start, end, whole in (
        (region.top, region.rows, got.top, ends[0], 500 - 500 % step_px),
        (region.left, region.columns, got.left, ends[1], 700 - 700 % step_px),
    ):
        wanted = set(range(max(first, 0), min(first + length, whole)))
        assert wanted <= set(range(start, end))
        if got != SENSOR and wanted:
            assert end - start < len(wanted) + 2 * step_px  # nor too large


@pytest.mark.parametrize("binning", [1, 2])
def test_lattice_keeps_its_place_on_the_sensor(binning: int) -> None:
    """Compare with binned images of pixel positions, an independent way to find where a pixel lies."""
    area = SensorArea(Region(16, 48, 160, 192), binning)
    there = moved_lattice(LATTICE, SensorArea(SENSOR, 1), area)
    y, x = np.mgrid[:500, :700].astype(float)[:, 16:176, 48:240]
    binned = [each.reshape(160 // binning, binning, 192 // binning, binning).mean(axis=(1, 3)) for each in (x, y)]
    x_of_column, y_of_row = binned[0][0], binned[1][:, 0]
    at = there.to_camera_px(np.array([[3.0, -2.0]]) * there.pitch_px)[0]
    on_sensor = (
        np.interp(at[0], np.arange(x_of_column.size), x_of_column),
        np.interp(at[1], np.arange(y_of_row.size), y_of_row),
    )
    np.testing.assert_allclose(on_sensor, LATTICE.to_camera_px(np.array([[3.0, -2.0]]) * 31.25)[0], atol=1e-9)
    back = moved_lattice(there, area, SensorArea(SENSOR, 1))
    np.testing.assert_allclose(
        [back.center_x_px, back.center_y_px, back.pitch_px], [LATTICE.center_x_px, LATTICE.center_y_px, 31.25]
    )


def test_lenslets_outside_frame_are_counted() -> None:
    upright = replace(LATTICE, rotation_rad=0.0, center_x_px=109.0, center_y_px=77.75, pitch_px=31.0)
    # Cells begin at 109 - 3.5 * 31 = 0.5 along x, and at 77.75 - 2.5 * 31 = 0.25 along y.
    assert lenslets_outside(upright, LENSLETS, SensorArea(Region(0, 0, 172, 240), 1)) == 0
    assert lenslets_outside(upright, LENSLETS, SensorArea(Region(0, 0, 155, 240), 1)) == 7  # one row is cut
    assert lenslets_outside(upright, LENSLETS, SensorArea(Region(0, 0, 156, 200), 1)) == 5  # one column
    assert lenslets_outside(upright, LENSLETS, SensorArea(Region(0, 0, 8, 8), 1)) == 35


@pytest.mark.parametrize("binning", [1, 2])
def test_region_around_lattice_contains_every_lenslet(binning: int) -> None:
    wide = replace(LATTICE, center_x_px=300.2, center_y_px=250.7)
    area = SensorArea(Region(32, 64, 400, 600), binning)
    seen = moved_lattice(wide, SensorArea(SENSOR, 1), area)
    region = region_around(seen, replace(LENSLETS, pixel_pitch_m=16e-6 * binning), area)
    part = SensorArea(region, 1)
    assert lenslets_outside(moved_lattice(wide, SensorArea(SENSOR, 1), part), LENSLETS, part) == 0
    assert region.rows == pytest.approx(6 * 31.25, abs=4)
    assert region.columns == pytest.approx(8 * 31.25, abs=4)


def test_saved_bench_restores_area() -> None:
    bench = replace(load_bench("live_demo"), lattice=LATTICE, sensor=LENSLETS)
    before, after = SensorArea(SENSOR, 1), SensorArea(Region(16, 32, 160, 192), 1)
    small = moved_bench(bench, before, after, SENSOR)
    assert isinstance(small.camera, SimulatedCameraSettings)
    assert (small.camera.rows, small.camera.columns) == (160, 192)
    assert small.lattice == replace(LATTICE, center_x_px=121.3 - 32, center_y_px=84.6 - 16)
    assert parse_bench(write_bench(small), "saved") == small
    real = replace(small, camera=DcamSettings(), light=CoolLEDSettings(port="COM1"))
    binned = moved_bench(real, before, SensorArea(Region(16, 32, 160, 192), 2), SENSOR)
    assert isinstance(binned.camera, DcamSettings)
    assert (binned.camera.binning, binned.camera.region) == (2, Region(16, 32, 160, 192))
    assert binned.sensor.pixel_pitch_m == 32e-6
    assert moved_bench(binned, SensorArea(Region(16, 32, 160, 192), 2), before, SENSOR).camera == replace(
        binned.camera, binning=1, region=None
    )
    with pytest.raises(BadValue, match="at least 8"):
        moved_bench(real, before, SensorArea(SENSOR, 4), SENSOR)


class Binning(FakeCamera):
    """Camera with 480 x 640 pixels and two binnings that refuses given requests."""

    def __init__(self) -> None:
        super().__init__()
        self.area = SensorArea(Region(0, 0, 480, 640), 1)
        self.refused: Region | None = None

    def _read_capabilities(self) -> CameraCapabilities:
        return replace(
            super()._read_capabilities(),
            binnings=(1, 2),
            sensor=Region(0, 0, 480, 640),
            region_step_px=16 * self.area.binning,
        )

    def _read_binning(self) -> int:
        return self.area.binning

    def _set_binning(self, binning: int) -> None:
        region, step_px = self.area.region, 16 * binning
        if region != Region(0, 0, 480, 640) and any(
            number % step_px for number in (region.top, region.left, region.rows, region.columns)
        ):
            raise BadValue(f"the region does not fit steps of {step_px}")
        self.area = SensorArea(region, binning)

    def _read_region(self) -> Region:
        return self.area.region

    def _set_region(self, region: Region) -> Region:
        if region == self.refused:
            raise BadValue("at least 64 rows")
        self.area = SensorArea(region, self.area.binning)
        return region


def test_camera_gets_regions_in_whole_steps() -> None:
    camera = Binning()
    assert set_area(camera, SensorArea(Region(20, 20, 100, 100), 1)) == SensorArea(Region(16, 16, 112, 112), 1)
    assert set_area(camera, SensorArea(Region(20, 20, 100, 100), 2)) == SensorArea(Region(0, 0, 128, 128), 2)
    assert set_area(camera, SensorArea(Region(0, 0, 480, 640), 2)) == SensorArea(Region(0, 0, 480, 640), 2)


def test_refused_area_restores_previous_one() -> None:
    camera = Binning()
    before = set_area(camera, SensorArea(Region(32, 32, 64, 64), 1))
    camera.refused = Region(64, 64, 32, 32)
    with pytest.raises(BadValue, match="at least 64"):
        set_area(camera, SensorArea(Region(64, 64, 32, 32), 2))
    assert SensorArea.of(camera) == before
    with pytest.raises(BadValue, match="there is no binning 3"):
        set_area(camera, SensorArea(Region(64, 64, 64, 64), 3))
    assert SensorArea.of(camera) == before


def test_real_driver_uses_configured_area() -> None:
    """The DCAM stand-in, whose counts encode the sensor pixel."""
    with dcam_stand_in() as stand_in, open_camera(stand_in) as camera:
        before = SensorArea.of(camera)
        for asked, taken in (
            (SensorArea(Region(20, 40, 100, 200), 2), SensorArea(Region(16, 32, 112, 208), 2)),
            (SensorArea(Region(400, 64, 64, 128), 1), SensorArea(Region(400, 64, 64, 128), 1)),
            (before, before),
        ):
            assert set_area(camera, asked) == taken
            camera.start()
            np.testing.assert_array_equal(camera.read(1.0).pixels, pattern(0, taken.region, taken.binning))
            camera.stop()


@pytest.fixture
def live_small(small_toml: Path) -> Iterator[tuple[Acquisition, list[Measurement]]]:
    """Acquisition on the simulated bench with measurements."""
    measurements: list[Measurement] = []
    bench = load_bench(small_toml, ("reconstruction.pupil_modes=6",))  # few enough for a part of the lenslets
    acquisition = Acquisition(bench, open_devices, sinks=(measurements.append,))
    acquisition.start()
    for step in start_up(acquisition, 5):
        step.result(HANG_S)
    wait_until(lambda: measurements)
    yield acquisition, measurements
    acquisition.close()


def newest(measurements: list[Measurement], since: int, holds: Callable[[Measurement], bool]) -> Measurement:
    """Wait until a measurement from index `since` on satisfies `holds`, and return the newest such."""
    wait_until(lambda: any(map(holds, measurements[since:])))
    return next(each for each in reversed(measurements) if holds(each))


def has_wavefront(measurement: Measurement) -> bool:
    return measurement.wavefront is not None


@pytest.mark.slow
@pytest.mark.long
def test_smaller_area_shows_same_lenslets_after_recalibration(
    live_small: tuple[Acquisition, list[Measurement]],
) -> None:
    acquisition, measurements = live_small
    before = newest(measurements, 0, has_wavefront).wavefront
    assert before is not None
    whole = acquisition.commands.submit(lambda instrument: SensorArea.of(instrument.devices.camera)).result(HANG_S)
    taken = acquisition.set_area(SensorArea(Region(17, 20, 140, 230), 1)).result(HANG_S)
    assert taken == SensorArea(Region(16, 16, 144, 224), 1)
    status = acquisition.status
    assert status is not None
    assert status.area == taken
    assert (status.dark.validity, status.reference.validity) == ("doubtful", "doubtful")
    assert "of another part of the sensor" in status.warning
    problem = "of another part of the sensor"
    newest(measurements, 0, lambda each: each.frame.pixels.shape == (144, 224) and problem in each.problem)
    with pytest.raises(WrongState, match="another part"):
        acquisition.commands.submit(lambda instrument: instrument.survey_lattice()).result(HANG_S)

    seen = len(measurements)
    # the dark, still of the whole sensor, must not be used
    acquisition.take_reference(5).result(HANG_S)
    newest(measurements, seen, has_wavefront)
    assert acquisition.status is not None
    assert "dark was taken of another part" in acquisition.status.warning
    acquisition.take_dark(5).result(HANG_S)
    assert acquisition.status.warning == ""
    now = newest(measurements, len(measurements), has_wavefront).wavefront
    assert now is not None
    # Cells begin at 121.3 - 3.5 * 31.25 = 11.9 and 84.6 - 2.5 * 31.25 = 6.5, and end at 230.7 and 162.7.
    inside = np.zeros((5, 7), np.bool_)
    inside[1:] = True  # what is cut off the first column and the last row is dark, but for the corner
    inside[4, 0] = False
    np.testing.assert_array_equal(now.displacement.valid, inside)
    np.testing.assert_allclose(now.displacement.mean[inside], before.displacement.mean[inside], atol=0.1)

    acquisition.set_area(whole).result(HANG_S)
    assert acquisition.commands.submit(lambda instrument: instrument.bench).result(HANG_S) == acquisition.bench


def test_lattice_outside_frame_is_reported(live_small: tuple[Acquisition, list[Measurement]]) -> None:
    acquisition, measurements = live_small
    acquisition.set_area(SensorArea(Region(0, 0, 64, 64), 1)).result(HANG_S)
    acquisition.take_reference(3).result(HANG_S)
    wait_until(lambda: "lenslets lie outside the frame of 64 x 64" in measurements[-1].problem)


def test_area_change_is_refused_during_recording(
    live_small: tuple[Acquisition, list[Measurement]], tmp_path: Path
) -> None:
    acquisition, measurements = live_small
    area = SensorArea(Region(0, 0, 160, 160), 1)
    acquisition.start_recording(tmp_path / "whole").result(HANG_S)
    with pytest.raises(WrongState, match="stop the recording"):
        acquisition.set_area(area).result(HANG_S)
    assert measurements[-1].frame.pixels.shape == (172, 240)
    acquisition.stop_recording()
    acquisition.set_area(area).result(HANG_S)
    wait_until(lambda: measurements[-1].frame.pixels.shape == (160, 160))
    acquisition.keep_recent(tmp_path / "kept").result(HANG_S)
    wait_until(lambda: acquisition.kept is not None and acquisition.kept.stage in {"finished", "ended early"})
    assert acquisition.kept is not None
    assert acquisition.kept.problem == ""
    kept = Recording(tmp_path / "kept")
    assert kept.frame(0).pixels.shape == (160, 160)
    assert isinstance(kept.bench.camera, SimulatedCameraSettings)
    assert kept.bench.camera.rows == 160


def test_fixed_camera_refuses_area(make_fixed: Instrument) -> None:
    with pytest.raises(BadValue, match="no binning 2"):
        make_fixed.set_area(SensorArea(Region(0, 0, 300, 430), 2))
    assert make_fixed.set_area(SensorArea(Region(0, 0, 16, 16), 1)) == SensorArea(Region(0, 0, 300, 430), 1)
    assert make_fixed.devices.camera.is_running


@pytest.fixture
def make_fixed() -> Iterator[Instrument]:
    camera = FakeCamera()
    with opener(camera)(BENCH, lambda _: None) as devices, closing(Instrument(devices, BENCH)) as instrument:
        camera.start()
        yield instrument
