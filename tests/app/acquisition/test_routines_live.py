"""Routines as commands of the acquisition: results, progress, and stale averages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.patience import HANG_S, wait_until

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument, Status
from app.acquisition.start_up import DARK, EXPOSURE, REFERENCE, start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.measurement.auto_exposure import AutoExposure, auto_expose
from app.measurement.routines import Cancelled, RoutineError
from app.measurement.sensor_region import SensorArea
from drivers.interface import BadValue, Devices, Region


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
        self.acquisition.commands.submit(command).result(HANG_S)

    @property
    def status(self) -> Status:
        return self.acquisition.commands.submit(lambda instrument: instrument.status()).result(HANG_S)


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
    found = live.acquisition.auto_expose().result(HANG_S)
    status = live.status
    assert "finding the exposure" in texts
    assert found.fill == pytest.approx(0.7, abs=0.05)
    assert (status.exposure_s, status.current_a) == (found.exposure_s, found.current_a)
    assert (status.is_light_on, status.is_running, status.is_sample_in) == (True, True, True)
    assert live.acquisition.activity.text == ""
    assert "20.0 ms" in status.warning  # dark and reference have another exposure now
    assert (status.dark.validity, status.reference.validity) == ("doubtful", "doubtful")


def test_auto_exposure_can_be_cancelled(quick_toml: Path) -> None:
    live = Live(quick_toml, "camera.readout_speed=2", "camera.exposure_s=9.0")
    try:
        future = live.acquisition.auto_expose()
        wait_until(lambda: live.acquisition.activity.text.startswith("finding"))
        time.sleep(0.3)
        live.acquisition.cancel()
        with pytest.raises(Cancelled):
            future.result(HANG_S)
        assert (live.status.exposure_s, live.status.is_light_on) == (9.0, False)
    finally:
        live.acquisition.close()


def test_background_check_command_needs_a_matching_dark(live: Live) -> None:
    with pytest.raises(RoutineError, match="no dark yet"):
        live.acquisition.check_background().result(HANG_S)
    started(live)
    check = live.acquisition.check_background().result(HANG_S)
    assert check.is_good
    assert "still good" in check.verdict
    assert (live.status.is_light_on, live.status.is_running) == (True, True)
    live.do(lambda instrument: instrument.devices.camera.set_exposure(0.05))
    with pytest.raises(RoutineError, match=r"the dark was taken at 20.0 ms: take it again"):
        live.acquisition.check_background().result(HANG_S)


def test_calibration_auto_exposes_before_dark_and_reference(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    with_sample: list[bool] = []

    def watched(devices: Devices, *arguments: Any, **how: Any) -> AutoExposure:
        with_sample.append(devices.stage.is_sample_in)
        return auto_expose(devices, *arguments, **how)

    monkeypatch.setattr("app.acquisition.instrument.auto_expose", watched)
    live.do(lambda instrument: instrument.devices.camera.set_exposure(1.0))
    live.do(lambda instrument: instrument.devices.stage.set_sample_in(True))
    live.acquisition.set_light_on(True).result(HANG_S)
    for step in (EXPOSURE, DARK, REFERENCE):
        step.begin(live.acquisition, 4).result(HANG_S)
    status = live.status
    assert with_sample == [False]
    assert (status.warning, status.dark.validity, status.reference.validity) == ("", "good", "good")
    assert (status.is_light_on, status.is_sample_in, status.is_running) == (True, True, False)  # as before
    reference = live.acquisition.commands.submit(lambda instrument: instrument.references.average).result(HANG_S)
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


@pytest.mark.slow
@pytest.mark.long
def test_each_mask_and_region_keeps_its_reference(live: Live) -> None:
    started(live)
    first = live.acquisition.commands.submit(lambda instrument: instrument.references.average).result(HANG_S)
    assert first is not None
    live.do(lambda instrument: instrument.change_settings((), "circle"))
    assert live.status.reference.validity == "doubtful"  # none yet: that of the square stays in use
    live.acquisition.take_reference(4).result(HANG_S)
    assert live.status.warning == ""
    live.do(lambda instrument: instrument.change_settings((), "square"))
    assert live.status.warning == ""
    assert "mask square" in live.status.reference.note
    assert live.acquisition.commands.submit(lambda instrument: instrument.references.average).result(HANG_S) is first
    whole = live.status.area
    live.acquisition.set_area(SensorArea(Region(0, 0, 168, 240), 1)).result(HANG_S)
    live.acquisition.take_dark(2).result(HANG_S)
    live.acquisition.take_reference(4).result(HANG_S)
    assert live.status.warning == ""
    live.acquisition.set_area(whole).result(HANG_S)
    assert live.status.warning == ""
    assert live.acquisition.commands.submit(lambda instrument: instrument.references.average).result(HANG_S) is first
    assert "4 frames" in live.status.dark.note


def test_refused_mask_leaves_the_settings(live: Live) -> None:
    started(live)
    before = live.status.bench
    change = live.acquisition.change_settings([("reconstruction.pupil_modes", 10)], "no mask")
    with pytest.raises(BadValue, match="there is no mask 'no mask'"):
        change.result(HANG_S)
    assert live.status.bench == before


def test_setting_of_a_wrong_type_is_refused(live: Live) -> None:
    started(live)
    before = live.status.bench
    for section in ("reconstruction", "sensor", "lattice.pitch_px"):
        with pytest.raises(BadValue):
            live.acquisition.change_settings([(section, None)]).result(HANG_S)
    assert live.status.bench == before


def test_recorded_dark_and_reference_are_used(live: Live) -> None:
    started(live)
    kept = live.acquisition.commands.submit(lambda instrument: instrument.calibration).result(HANG_S)
    assert kept is not None
    assert kept.dark is not None
    recorded = replace(kept, dark=replace(kept.dark, frames=7), reference=replace(kept.reference, frames=9))
    live.acquisition.use(recorded).result(HANG_S)
    used = live.acquisition.commands.submit(lambda instrument: instrument.calibration).result(HANG_S)
    assert used is not None
    assert (used.dark, used.reference) == (recorded.dark, recorded.reference)
    assert [live.status.dark.note, live.status.reference.note] == ["as recorded"] * 2
    live.acquisition.use(replace(recorded, dark=None)).result(HANG_S)
    assert live.status.dark.validity == "missing"
