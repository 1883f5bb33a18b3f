"""The worker on a slow computer, or with slow devices: frames are skipped and not queued, and it goes on."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from support.patience import HANG_S, wait_until
from support.running import Running, is_dark

from app.acquisition.instrument import Instrument
from app.bench.config import load_bench
from app.measurement.measurement import SKIPPED, Measurement
from drivers.interface import Frame
from simulated_devices.bench import SimulatedLight


def test_slow_frames_announce_themselves(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the watchdog would take each for a hang, and switch the light off."""
    promised, measure = list[float](), Instrument.measure

    def measure_slowly(instrument: Instrument, frame: Frame) -> Measurement:
        time.sleep(0.35)
        return measure(instrument, frame)

    monkeypatch.setattr(SimulatedLight, "keep_alive", lambda _, within_s: promised.append(within_s))
    monkeypatch.setattr(Instrument, "measure", measure_slowly)
    running.begin()
    wait_until(lambda: any(5 * 0.35 < within_s < 10 for within_s in promised))
    assert min(promised) == 1.5


def test_slow_reconstruction_skips_to_newest_frame(quick_toml: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measure = Instrument.measure

    def slowly(instrument: Instrument, frame: Frame) -> Measurement:
        time.sleep(0.2)
        return measure(instrument, frame)

    running = Running(load_bench(quick_toml, ("camera.exposure_s=0.0139",)))
    try:
        running.begin()
        monkeypatch.setattr(Instrument, "measure", slowly)
        first = len(running.measurements)
        wait_until(lambda: running.acquisition.counts.reconstructed >= first + 16)
        running.end()
    finally:
        running.acquisition.close()
    everything = [measurement.frame.index for measurement in running.measurements]
    measured = [measurement for measurement in running.measurements if measurement.wavefront is not None]
    index = [measurement.frame.index for measurement in measured]
    last = measured[-1]
    counts = [measurement.counts for measurement in running.measurements]
    # Five of 72 frames per second are measured; the others are skipped, not queued. The sinks get all.
    assert np.median(np.diff(index[first + 2 :])) > 8
    assert np.all(np.diff(everything) > 0)
    assert len(everything) == counts[-1].acquired
    assert {measurement.problem for measurement in running.measurements} == {"", SKIPPED}
    assert all(count.acquired + count.lost == at + 1 for at, count in zip(everything, counts, strict=True))
    assert last.counts.reconstructed == len(measured) < last.counts.acquired
    # With a queue, each measurement would be 0.19 s older than the previous one.
    assert min(measurement.latency_s for measurement in measured[-4:]) < measured[first + 2].latency_s + 1.0
    assert running.newest is last


def test_slow_skipping_still_measures_and_stops(quick_toml: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measure, skip = Instrument.measure, Instrument.skip

    def slowly(instrument: Instrument, frame: Frame) -> Measurement:
        time.sleep(0.2)
        return measure(instrument, frame)

    def more_slowly_than_they_come(instrument: Instrument, frame: Frame) -> Measurement:
        time.sleep(0.03)
        return skip(instrument, frame)

    running = Running(load_bench(quick_toml, ("camera.exposure_s=0.0139",)))
    try:
        running.begin()
        monkeypatch.setattr(Instrument, "measure", slowly)
        monkeypatch.setattr(Instrument, "skip", more_slowly_than_they_come)
        wait_until(lambda: running.measurements[-1].problem == SKIPPED)
        first = running.acquisition.counts.reconstructed
        wait_until(lambda: running.acquisition.counts.reconstructed >= first + 2)
        assert running.acquisition.commands.submit(is_dark).result(HANG_S) is False
    finally:
        running.acquisition.close(HANG_S)
    assert not running.acquisition.is_alive
