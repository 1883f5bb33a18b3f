"""Stage times of the live path."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest
from support.patience import HANG_S

from app.acquisition.devices import open_devices
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.timing import Timings
from reconstruction.displacement import Displacement
from reconstruction.reconstructor import Reconstructor


def test_empty_stage_has_no_statistics() -> None:
    summary = Timings().summary()["draw"]
    assert summary.count == 0
    assert math.isnan(summary.p50_s)


def test_percentiles_cover_kept_times_and_maximum_all() -> None:
    timings = Timings()
    timings.note("register", 7.0)
    for index in range(10_000):
        timings.note("register", index % 100 / 1000)
    summary = timings.summary()["register"]
    assert summary.count == 10_001
    assert summary.p50_s == pytest.approx(0.05, abs=0.001)
    assert summary.p99_s == pytest.approx(0.098, abs=0.001)
    assert summary.max_s == 7.0


def test_failing_body_is_not_timed() -> None:
    timings = Timings()
    with timings.of("register"):
        pass
    with pytest.raises(ValueError, match="no"), timings.of("register"):
        raise ValueError("no")
    assert timings.summary()["register"].count == 1


def test_longest_time_can_be_forgotten() -> None:
    timings = Timings()
    timings.note("record", 0.5)
    timings.forget_longest()
    assert math.isnan(timings.summary()["record"].max_s)
    timings.note("record", 0.1)
    summary = timings.summary()["record"]
    assert (summary.count, summary.max_s) == (2, 0.1)


def test_every_stage_of_the_worker_is_timed(monkeypatch: pytest.MonkeyPatch, small_toml: Path) -> None:
    register = Reconstructor.register

    def register_slowly(*arguments: Any, **named: Any) -> Displacement:
        time.sleep(0.02)
        return register(*arguments, **named)

    monkeypatch.setattr(Reconstructor, "register", register_slowly)
    acquisition = Acquisition(load_bench(small_toml), open_devices, sinks=(lambda _: time.sleep(0.01),))
    acquisition.start()
    for step in start_up(acquisition, 3):
        step.result(HANG_S)
    while acquisition.is_alive and acquisition.timings.summary()["publish"].count < 5:
        acquisition.commands.submit(lambda _: None).result(HANG_S)
    acquisition.close()
    summary = acquisition.timings.summary()
    for stage in ("wait", "copy", "register", "reconstruct", "publish", "to_result"):
        assert summary[stage].count >= 5
        assert 0 <= summary[stage].p50_s <= summary[stage].p99_s <= summary[stage].max_s
    assert summary["register"].p50_s >= 0.02
    assert summary["publish"].p50_s >= 0.01
    assert summary["to_result"].p50_s >= summary["copy"].p50_s + 0.02  # latency includes the registration
    assert {summary[stage].count for stage in ("record", "draw", "to_screen")} == {0}
