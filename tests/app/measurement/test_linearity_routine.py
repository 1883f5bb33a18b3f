"""The routine that measures a camera's nonlinearity, and what calibrations and results make of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run

from app.bench.config import Bench, load_bench, parse_bench, write_bench
from app.evaluation.frames import NoiseFreeFrames
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.linearity import measure_linearity
from app.measurement.offline_reconstructor import reconstructor
from app.measurement.routines import NO_CALLBACKS, Cancelled, RoutineCallbacks, RoutineError
from app.recording.calibration_files import read_calibration, write_calibration
from drivers.interface import Devices, Range
from drivers.light_source import ManualLight
from reconstruction.arrays import Floats
from reconstruction.frame.linearity import Linearity
from reconstruction.frame.linearity_fit import MeasuredLinearity
from reconstruction.geometry import Lattice
from reconstruction.quality.verdict import Fault
from studies.exposure_bench import PITCH_PX, LampScene, exposure_bench

LOSS = 0.05  # of full scale
WIDE = Range(1e-3, 10.0)


def measured(scene: LampScene, *, exposure_s: float = 0.1) -> MeasuredLinearity:
    devices, *_ = exposure_bench(scene, exposure_s=exposure_s)
    return measure_linearity(devices, PITCH_PX, 4, NO_CALLBACKS)


def scene_of(loss: float, **changes: Any) -> LampScene:
    return LampScene(counts_per_a_s=1e6, exposure_range_s=WIDE, nonlinearity=loss, **changes)


@pytest.mark.parametrize(("loss", "flicker"), [(LOSS, 0.0), (-LOSS, 1e-3), (0.0, 0.0)])
def test_routine_finds_the_curve_of_the_camera(loss: float, flicker: float) -> None:
    found = measured(scene_of(loss, flicker=flicker))
    highest = found.linearity.highest_counts
    part = loss / 2**16 or 1e-12
    light = (1 - np.sqrt(1 - 4 * part * highest)) / (2 * part)
    assert highest > 0.7 * 2**16
    assert found.linearity.light(np.array([highest]))[0] == pytest.approx(light, abs=(4 * found.sigma + 3e-4) * highest)
    assert found.linearity.chi_square == pytest.approx(1, abs=0.3)  # of about 600 bins and exposures
    assert found.linearity.amplifier == "normal"


def test_short_exposures_are_made_longer_by_less_current() -> None:
    scene = replace(scene_of(LOSS), counts_per_a_s=7e6, exposure_range_s=Range(0.0139, 1.0))
    devices, camera, lamp = exposure_bench(scene, exposure_s=0.0139)
    found = measure_linearity(devices, PITCH_PX, 4, NO_CALLBACKS)
    assert max(camera.exposed_s) > 8 * min(camera.exposed_s[20:])
    assert found.linearity.quadratic == pytest.approx(LOSS * found.linearity.highest_counts / 2**16, abs=0.004)
    assert lamp.current_a == 0.35
    assert camera.exposure_s == pytest.approx(0.0139)


def test_light_that_goes_off_amid_the_exposures_ends_the_routine() -> None:
    devices, _, lamp = exposure_bench(scene_of(LOSS), exposure_s=0.1)

    def go_off(_: object, fraction: float) -> None:
        if fraction > 0.9:
            lamp._shines = False

    with pytest.raises(RoutineError, match="the light is off: switch it on"):
        measure_linearity(devices, PITCH_PX, 2, RoutineCallbacks(go_off))


def test_devices_are_restored_also_after_a_stop() -> None:
    for most in (3, 1000):
        devices, camera, lamp = exposure_bench(scene_of(LOSS), exposure_s=0.2, is_on=True)
        camera.start()

        def stop(camera: Any = camera, most: int = most) -> bool:
            return len(camera.exposed_s) > most

        try:
            measure_linearity(devices, PITCH_PX, 2, RoutineCallbacks(should_stop=stop))
        except Cancelled:
            assert most == 3
        assert camera.is_running
        assert (lamp.current_a, lamp.is_on) == (0.35, True)
        assert camera.exposure_s == pytest.approx(0.2)
        assert devices.stage.is_sample_in


@pytest.mark.parametrize(
    ("scene", "why"),
    [
        (scene_of(0.0, flicker=0.04), "flickers by"),
        (replace(scene_of(0.0), exposure_range_s=Range(0.05, 0.1), current_range_a=Range(0.2, 0.7)), "do not span"),
        (scene_of(0.0, well_counts=30_000), "do not follow"),
    ],
)
def test_what_cannot_be_told_is_refused(scene: LampScene, why: str) -> None:
    with pytest.raises(RoutineError, match=why):
        measured(scene)


def test_lights_without_control_and_single_frames_are_refused() -> None:
    devices, camera, _ = exposure_bench(scene_of(0.0), exposure_s=0.1)
    with pytest.raises(RoutineError, match="at least 2 frames"):
        measure_linearity(devices, PITCH_PX, 1, NO_CALLBACKS)
    with pytest.raises(RoutineError, match="by hand"):
        measure_linearity(Devices(camera, ManualLight(), devices.stage), PITCH_PX, 4, NO_CALLBACKS)


# A camera with the signal S = L - b L^2, whose inverse the cubic describes to 0.1 %.
TRUE_E, READ = 0.25, 4.0  # counts per electron, counts
LOST_PER_COUNT = 0.08 / 40_000
CURVE = Linearity(quadratic=0.0706, cubic=0.0140, highest_counts=36_000.0, amplifier="em")


def photographs(light: Floats, frames: int, seed: int, lost: float = LOST_PER_COUNT) -> tuple[Average, Average]:
    """Dark and mean of frames with shot noise before the nonlinearity and read noise after it."""
    random = np.random.default_rng(seed)
    counts = random.poisson(light / TRUE_E, (frames, *light.shape)) * TRUE_E
    counts = counts - lost * counts**2 + READ * random.standard_normal(counts.shape) + 300
    dark = 300 + READ * random.standard_normal(counts.shape)
    average, other = (
        Average(
            each.mean(axis=0).astype(np.float32),
            each.var(axis=0, ddof=min(frames - 1, 1)).astype(np.float32),
            frames,
            0.1,
            1.0,
            "em",
        )
        for each in (dark, counts)
    )
    return average, other


LATTICE = Lattice(center_x_px=120.0, center_y_px=86.0, pitch_px=31.25)


@pytest.fixture(scope="module")
def bench(small_toml: Path) -> Bench:
    return load_bench(small_toml)


def test_noise_is_that_of_the_light(bench: Bench) -> None:
    """Shot noise of the light is what it was before the nonlinearity: its variance needs the slope of the curve."""
    y, x = np.mgrid[:200, :240]
    light = 20_000 * (1 + np.sin(x / 9) * np.sin(y / 7)) * 0.95
    dark, reference = photographs(light, 12, 1)
    calibration = Calibration(
        bench=replace(bench, linearity=CURVE), dark=dark, reference=reference, lattice=LATTICE, full_scale=65535.0
    )
    known = calibration.noise
    assert known.of_frame is not None
    assert known.of_frame.counts_per_electron == pytest.approx(TRUE_E, rel=0.01)
    assert known.of_frame.read_noise_counts == pytest.approx(READ, rel=0.02)
    assert known.curve is not None
    assert known.curve.loss == 0
    plain = replace(calibration, bench=bench).noise
    assert plain.of_frame is not None
    assert plain.of_frame.counts_per_electron < 0.9 * TRUE_E
    assert plain.curve is not None
    assert plain.curve.loss > 0.1


@pytest.mark.slow
def test_dimmer_frames_have_the_light_of_the_reference(bench: Bench) -> None:
    """A frame of half the light of a compressed reference: only the correction leaves the shape of its subimages."""
    light = np.asarray(NoiseFreeFrames(bench).reference(), np.float64)
    light *= 38_000 / light.max()
    reference, frame = (each - LOST_PER_COUNT * 1.5 * each**2 for each in (light, light / 2))
    dark = np.zeros_like(light)
    steep = Linearity(quadratic=0.0963, cubic=0.0320, highest_counts=float(reference.max()))
    misfits = []
    for each in (bench, replace(bench, linearity=steep)):
        found = reconstructor(each, reference, dark=dark, full_scale=np.inf)(frame).displacement
        misfits.append(float(np.median(found.residual_rms[found.valid])))
    assert misfits[1] < 0.25 * misfits[0]


def test_other_amplifier_or_gain_than_measured_is_a_fault(bench: Bench) -> None:
    dark, reference = photographs(np.full((200, 240), 1000.0), 4, 2)
    calibration = Calibration(
        bench=replace(bench, linearity=CURVE), dark=dark, reference=reference, lattice=LATTICE, full_scale=65535.0
    )
    assert not calibration.linearity_quality.faults
    for changed in (replace(reference, amplifier="normal"), replace(reference, em_gain=4.0)):
        faults = replace(calibration, reference=changed).linearity_quality
        assert faults.faults == Fault.LINEARITY
        assert "calibrate --linearity" in faults.sentence
    unknown = replace(CURVE, amplifier="")
    assert not replace(calibration, bench=replace(bench, linearity=unknown)).linearity_quality.faults


def test_curve_is_stored_with_bench_and_calibration(bench: Bench, tmp_path: Path) -> None:
    corrected = replace(bench, linearity=CURVE)
    assert parse_bench(write_bench(corrected), "a bench") == corrected
    assert "[linearity]" not in write_bench(bench)  # as earlier versions wrote it
    dark, reference = photographs(np.full((200, 240), 1000.0), 4, 2)
    for each in (bench, corrected):
        folder = tmp_path / str(each is bench)
        write_calibration(
            folder, Calibration(bench=each, dark=dark, reference=reference, lattice=LATTICE, full_scale=65535.0)
        )
        assert read_calibration(folder).bench.linearity == each.linearity


@pytest.mark.slow
def test_results_of_files_say_that_they_are_corrected(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    light = np.asarray(NoiseFreeFrames(bench).reference(), np.float64)
    paths = []
    for name, brightness, seed in (("reference", 36_000.0, 3), ("frame", 18_000.0, 4)):
        _, photograph = photographs(light * brightness / light.max(), 1, seed)
        paths.append(tmp_path / f"{name}.tif")
        tifffile.imwrite(paths[-1], np.rint(photograph.mean).astype(np.uint16))
    toml, out = tmp_path / "bench.toml", tmp_path / "r.nc"
    toml.write_text(write_bench(replace(bench, linearity=CURVE)))
    assert run(monkeypatch, "reconstruct", paths[1], "--reference", paths[0], "--bench", toml, "--out", out) == 0
    with xr.open_dataset(out) as results:
        assert results.attrs["linearity"] == f"corrected: {CURVE.sentence}"
