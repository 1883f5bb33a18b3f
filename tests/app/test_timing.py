"""The times of the live path: what is kept, what is said of it, and that every stage is measured."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from support.patience import HANG_S

from app.acquisition.devices import open_devices
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.timing import STAGES, Timings


def test_nothing_noted_is_nothing_known() -> None:
    summary = Timings().summary()["draw"]
    assert summary.count == 0
    assert math.isnan(summary.p50_s)


def test_percentiles_of_the_last_thousands_and_the_maximum_of_all() -> None:
    timings = Timings()
    timings.note("register", 7.0)
    for index in range(10_000):
        timings.note("register", index % 100 / 1000)
    summary = timings.summary()["register"]
    assert summary.count == 10_001
    assert summary.p50_s == pytest.approx(0.05, abs=0.001)
    assert summary.p99_s == pytest.approx(0.098, abs=0.001)
    assert summary.max_s == 7.0


def test_a_span_holds_what_was_noted_from_its_begin_to_its_end() -> None:
    timings = Timings()
    timings.note("register", 7.0)
    span = timings.begin_span(10_000)
    for index in range(6_000):  # more than are remembered otherwise
        timings.note("register", float(index < 3_500))
    timings.end_span(span)
    timings.note("register", 9.0)
    summary = span.summary()["register"]
    assert (summary.count, summary.p50_s, summary.max_s) == (6_000, 1.0, 1.0)
    assert timings.summary()["register"].max_s == 9.0
    assert timings.summary()["register"].p50_s == 0.0


def test_what_fails_is_not_timed() -> None:
    timings = Timings()
    with timings.of("register"):
        pass
    with pytest.raises(ValueError, match="no"), timings.of("register"):
        raise ValueError("no")
    assert timings.summary()["register"].count == 1


def test_every_stage_of_the_worker_is_timed(small_toml: Path) -> None:
    acquisition = Acquisition(load_bench(small_toml), open_devices)
    acquisition.start()
    for step in start_up(acquisition, 3):
        step.result(HANG_S)
    while acquisition.is_alive and acquisition.timings.summary()["publish"].count < 5:
        acquisition.submit(lambda _: None).result(HANG_S)
    acquisition.close()
    summary = acquisition.timings.summary()
    worker = [stage for stage in STAGES if stage not in {"record", "draw", "to_screen"}]
    assert all(summary[stage].count >= 5 and summary[stage].p50_s >= 0 for stage in worker)
    parts = sum(summary[stage].p50_s for stage in ("copy", "register", "reconstruct"))
    assert summary["to_result"].max_s >= parts / 2  # the age of a result holds the work on it
