"""Routines as commands of the acquisition: results, progress, and stale averages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.optics import SmallBench, at_views
from support.patience import HANG_S, wait_until

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument, Status
from app.acquisition.kept_averages import KeptAverages
from app.acquisition.start_up import DARK, EXPOSURE, REFERENCE, start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.measurement.auto_exposure import AutoExposure, auto_expose
from app.measurement.averages import Average
from app.measurement.routines import Cancelled, Circumstances, RoutineError
from app.measurement.sensor_region import SensorArea
from drivers.interface import BadValue, Devices, DeviceTimeout, Region
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.frame.pixels import KnownCamera
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from simulated_devices.camera import SimulatedCamera


class Live:
    """Acquisition on the small bench, with its devices and futures."""

    def __init__(self, toml: Path, *overrides: str) -> None:
        self.devices: Devices | None = None
        self.acquisition = Acquisition(load_bench(toml, overrides), self._open)
        self.acquisition.start()

    def _open(self, *arguments: object) -> Devices:
        self.devices = open_devices(*arguments)  # type: ignore[arg-type] # passed through
        return self.devices

    def do(self, command: Callable[[Instrument], object]) -> None:
        self.acquisition.submit(command).result(HANG_S)

    @property
    def status(self) -> Status:
        return self.acquisition.submit(lambda instrument: instrument.status()).result(HANG_S)


@pytest.fixture
def live(quick_toml: Path) -> Iterator[Live]:
    live = Live(quick_toml)
    yield live
    live.acquisition.close()


def started(live: Live) -> None:
    for step in start_up(live.acquisition, 4):
        step.result(HANG_S)
    assert live.status.warning == ""


def test_auto_expose_command_reaches_target_and_restores_state(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    started(live)
    live.do(lambda instrument: instrument.devices.camera.set_exposure(1.0))
    texts = set[str]()
    show = live.acquisition._path.show

    def note(*arguments: Any) -> None:
        texts.add(live.acquisition.activity.text)
        show(*arguments)

    monkeypatch.setattr(live.acquisition._path, "show", note)
    found = live.acquisition.submit(Instrument.auto_expose).result(HANG_S)
    status = live.status
    assert "finding the exposure" in texts
    assert found.fill == pytest.approx(0.7, abs=0.05)
    assert (status.exposure_s, status.current_a) == (found.exposure_s, found.current_a)
    assert (status.is_light_on, status.is_running, status.is_sample_in) == (True, True, True)
    assert live.acquisition.activity.text == ""
    assert "20.0 ms" in status.warning  # dark and reference have another exposure now
    assert (status.dark.validity, status.reference.validity) == ("doubtful", "doubtful")


def test_failed_auto_exposure_keeps_loop_running(quick_toml: Path) -> None:
    dim = Live(quick_toml, "light.maximum_current_a=1e-6", "light.current_a=0.0")
    try:
        with pytest.raises(RoutineError, match="check the lamp"):
            dim.acquisition.submit(Instrument.auto_expose).result(HANG_S)
        status = dim.status
        assert (status.is_light_on, status.current_a, status.exposure_s) == (False, 0.0, 0.02)
        assert dim.acquisition.is_alive
    finally:
        dim.acquisition.close()


def test_auto_exposure_can_be_cancelled(quick_toml: Path) -> None:
    live = Live(quick_toml, "camera.readout_speed=2", "camera.exposure_s=9.0")
    try:
        future = live.acquisition.submit(Instrument.auto_expose)
        wait_until(lambda: live.acquisition.activity.text.startswith("finding"))
        time.sleep(0.3)
        live.acquisition.cancel()
        with pytest.raises(Cancelled):
            future.result(HANG_S)
        assert (live.status.exposure_s, live.status.is_light_on) == (9.0, False)
    finally:
        live.acquisition.close()


def test_camera_stalled_in_auto_exposure_ends_loop_dark(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.measurement.routines._MARGIN_S", 0.2)
    started(live)
    assert live.devices is not None
    camera, light = live.devices.camera, live.devices.light
    assert isinstance(camera, SimulatedCamera)
    was_off: list[bool] = []
    monkeypatch.setattr(light, "close", lambda: was_off.append(not light.is_on))
    live.do(lambda instrument: instrument.devices.camera.stop())  # or the acquisition itself would miss the frames
    monkeypatch.setattr(camera, "read", _no_frame)
    with pytest.raises(DeviceTimeout):
        live.acquisition.submit(Instrument.auto_expose).result(HANG_S)
    live.acquisition.close()
    assert was_off == [True]


def _no_frame(_timeout_s: float) -> None:
    raise DeviceTimeout("no frame came")


def test_background_check_command_needs_a_matching_dark(live: Live) -> None:
    with pytest.raises(RoutineError, match="no dark yet"):
        live.acquisition.submit(Instrument.check_background).result(HANG_S)
    started(live)
    check = live.acquisition.submit(Instrument.check_background).result(HANG_S)
    assert check.is_good
    assert "still good" in check.verdict
    assert (live.status.is_light_on, live.status.is_running) == (True, True)
    live.do(lambda instrument: instrument.devices.camera.set_exposure(0.05))
    with pytest.raises(RoutineError, match=r"the dark was taken at 20.0 ms: take it again"):
        live.acquisition.submit(Instrument.check_background).result(HANG_S)


def test_calibration_auto_exposes_before_dark_and_reference(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    with_sample: list[bool] = []

    def watched(devices: Devices, *arguments: Any, **how: Any) -> AutoExposure:
        with_sample.append(devices.stage.is_sample_in)
        return auto_expose(devices, *arguments, **how)

    monkeypatch.setattr("app.acquisition.instrument.auto_expose", watched)
    live.do(lambda instrument: instrument.devices.camera.set_exposure(1.0))
    live.do(lambda instrument: instrument.devices.stage.set_sample_in(True))
    live.acquisition.submit(Instrument.set, "is_light_on", True).result(HANG_S)
    for step in (EXPOSURE, DARK, REFERENCE):
        step.begin(live.acquisition, 4).result(HANG_S)
    status = live.status
    assert with_sample == [False]
    assert (status.warning, status.dark.validity, status.reference.validity) == ("", "good", "good")
    assert (status.is_light_on, status.is_sample_in, status.is_running) == (True, True, False)  # as before
    reference = live.acquisition.submit(lambda instrument: instrument.references.average).result(HANG_S)
    assert reference is not None
    assert np.percentile(reference.mean, 99.5) / 65535 == pytest.approx(0.68, abs=0.08)


def paused(change: Callable[[Instrument], object]) -> Callable[[Instrument], None]:
    """Change a setting that needs a stopped camera."""

    def command(instrument: Instrument) -> None:
        instrument.devices.camera.stop()
        change(instrument)

    return command


@pytest.mark.parametrize(
    ("change", "dark", "reference", "warning"),
    [
        (lambda instrument: instrument.devices.camera.set_exposure(0.05), "doubtful", "doubtful", "at 20.0 ms"),
        (lambda instrument: instrument.devices.camera.set_em_gain(2.0), "doubtful", "doubtful", "amplifier or gain"),
        (
            paused(lambda instrument: instrument.devices.camera.set_readout_speed(2)),
            "doubtful",
            "doubtful",
            "with readout speed 3",
        ),
        (
            paused(lambda instrument: instrument.devices.camera.set_region(Region(16, 0, 144, 240))),
            "doubtful",
            "doubtful",
            "another part of the sensor",
        ),
        (lambda instrument: instrument.devices.stage.set_mask("stars"), "good", "doubtful", "with the mask square"),
        (lambda instrument: instrument.devices.light.set_current(0.2), "good", "good", ""),
    ],
)
def test_changes_make_dark_and_reference_stale(
    live: Live, change: Callable[[Instrument], object], dark: str, reference: str, warning: str
) -> None:
    started(live)
    live.do(change)
    status = live.status
    assert (status.dark.validity, status.reference.validity) == (dark, reference)
    assert warning in status.warning
    assert bool(warning) is bool(status.warning)


@pytest.mark.parametrize("level", [0.03, 0.5, 2.0])
def test_reference_is_valid_at_any_brightness(paper_bench: SmallBench, level: float) -> None:
    """A changed current therefore does not make it stale."""
    frame, truth_px = paper_bench.tilted(4000.0, 1500.0)
    reconstructor = paper_bench.reconstructor(registration=RegistrationSettings(warp="quadratic"))
    as_taken, brighter = (reconstructor.register((frame * each).astype(np.float32)) for each in (1.0, level))
    assert brighter.valid.all()
    np.testing.assert_allclose(brighter.coefficients, as_taken.coefficients, atol=1e-4)
    assert np.abs(at_views(brighter) - truth_px).max() < 0.05


@pytest.mark.slow
def test_reference_noise_enters_covariance(small_bench: SmallBench) -> None:
    """With independent noise in frames and references, displacements scatter as their covariance predicts."""
    random = np.random.default_rng(8)
    per_electron = float(small_bench.reference.max()) / 4000
    noise = CameraNoise(per_electron, 8 * per_electron)

    def noisy(frames: int) -> np.ndarray:
        scatter = np.sqrt(noise.variance(small_bench.reference) / frames)
        return (small_bench.reference + scatter * random.standard_normal(scatter.shape)).astype(np.float32)

    for frames in (1, 4):
        errors, variances = [], []
        for _ in range(6):
            displacement = small_bench.reconstructor(
                reference=noisy(frames),
                registration=RegistrationSettings(warp="affine"),
                reconstruction=ReconstructionSettings(),
                camera=KnownCamera(noise=KnownNoise(noise, frames)),
            ).register(noisy(1))
            errors.append(displacement.coefficients[displacement.valid])
            variances.append(displacement.variance[displacement.valid])
        assert np.mean(np.square(errors)) / np.mean(variances) == pytest.approx(1.0, abs=0.2)


@pytest.mark.slow
@pytest.mark.long
def test_each_mask_and_region_keeps_its_reference(live: Live) -> None:
    started(live)
    first = live.acquisition.submit(lambda instrument: instrument.references.average).result(HANG_S)
    assert first is not None
    live.do(lambda instrument: instrument.change_settings((), "circle"))
    assert live.status.reference.validity == "doubtful"  # none yet: that of the square stays in use
    live.acquisition.submit(Instrument.take_reference, 4).result(HANG_S)
    assert live.status.warning == ""
    live.do(lambda instrument: instrument.change_settings((), "square"))
    assert live.status.warning == ""
    assert "mask square" in live.status.reference.note
    assert live.acquisition.submit(lambda instrument: instrument.references.average).result(HANG_S) is first
    whole = live.status.area
    live.acquisition.set_area(SensorArea(Region(0, 0, 168, 240), 1)).result(HANG_S)
    live.acquisition.submit(Instrument.take_dark, 2).result(HANG_S)
    live.acquisition.submit(Instrument.take_reference, 4).result(HANG_S)
    assert live.status.warning == ""
    live.acquisition.set_area(whole).result(HANG_S)
    assert live.status.warning == ""
    assert live.acquisition.submit(lambda instrument: instrument.references.average).result(HANG_S) is first
    assert "4 frames" in live.status.dark.note


@pytest.mark.slow
def test_reference_of_a_mask_is_stale_at_another_exposure(live: Live) -> None:
    started(live)
    live.do(lambda instrument: instrument.change_settings((), "circle"))
    live.do(lambda instrument: instrument.devices.camera.set_exposure(0.05))
    live.do(lambda instrument: instrument.change_settings((), "square"))
    assert live.status.reference.validity == "doubtful"
    assert "at 20.0 ms" in live.status.warning


def test_refused_mask_leaves_the_settings(live: Live) -> None:
    started(live)
    before = live.status.bench
    change = live.acquisition.submit(Instrument.change_settings, [("reconstruction.pupil_modes", 10)], "no mask")
    with pytest.raises(BadValue, match="there is no mask 'no mask'"):
        change.result(HANG_S)
    assert live.status.bench == before


AVERAGE = Average(np.zeros((8, 8), np.float32), np.zeros((8, 8), np.float32), 1, 0.02, 1.0, "em")
IN_REGIONS = [Circumstances(0.02, "em", 1.0, 3, 1, Region(0, 0, 8, 8 + index), "square") for index in range(12)]


def test_dark_of_a_region_is_kept_for_every_mask() -> None:
    kept = KeptAverages("dark", is_lit=False)
    for now in IN_REGIONS[:2]:
        kept.keep(AVERAGE, now)
    now = replace(IN_REGIONS[0], mask="circle")
    kept.choose(now)
    assert not kept.doubt(now)


def test_reference_taken_again_is_no_longer_the_oldest() -> None:
    kept = KeptAverages("reference", is_lit=True)
    for index in (*range(8), 0, 8):  # one more than are kept
        kept.keep(AVERAGE, IN_REGIONS[index])
    kept.choose(IN_REGIONS[0])
    assert not kept.doubt(IN_REGIONS[0])
    kept.choose(IN_REGIONS[1])
    assert kept.doubt(IN_REGIONS[1])


def test_only_the_newest_references_are_kept() -> None:
    kept, taken = KeptAverages("reference", is_lit=True), IN_REGIONS
    for now in taken:
        kept.keep(AVERAGE, now)
    kept.choose(taken[3])
    assert kept.doubt(taken[3])  # forgotten: the newest stays in use
    kept.choose(taken[4])
    assert not kept.doubt(taken[4])


def test_recorded_dark_and_reference_are_used(live: Live) -> None:
    started(live)
    kept = live.acquisition.submit(lambda instrument: instrument.calibration).result(HANG_S)
    assert kept is not None
    assert kept.dark is not None
    recorded = replace(kept, dark=replace(kept.dark, frames=7), reference=replace(kept.reference, frames=9))
    live.acquisition.submit(Instrument.use, recorded).result(HANG_S)
    used = live.acquisition.submit(lambda instrument: instrument.calibration).result(HANG_S)
    assert used is not None
    assert (used.dark, used.reference) == (recorded.dark, recorded.reference)
    assert [live.status.dark.note, live.status.reference.note] == ["as recorded"] * 2
    live.acquisition.submit(Instrument.use, replace(recorded, dark=None)).result(HANG_S)
    assert live.status.dark.validity == "missing"
