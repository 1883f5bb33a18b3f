"""Latency by the camera's clock, which drifts beside the computer's; counts, gaps, and old frames skipped."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.acquisition.frame_path import FramePath
from app.measurement.measurement import FrameTotals, Measurement
from app.timing import Timings
from drivers.interface import DeviceTimeout, Frame

_frame = partial(Frame, pixels=np.zeros((2, 2), np.uint16), em_gain=1.0)


def measured_alone(frame: Frame, *, is_foreign: bool) -> Measurement:
    return Measurement(frame, None, "foreign" if is_foreign else "")


@pytest.mark.parametrize("drift", [-50e-6, 0.0, 50e-6, 200e-6])
def test_exposure_end_follows_a_drifting_clock(drift: float) -> None:
    """Two hours at 1 Hz; transfers take 10 ... 30 ms."""
    path = FramePath((), Timings(), lambda _: False)
    rng = np.random.default_rng(0)
    for index in range(7200):
        end_s = 100.0 + index
        arrived_s = end_s + rng.uniform(0.01, 0.03)
        path._count(_frame(index=index, camera_time_s=(1 - drift) * index, host_time_s=arrived_s, exposure_s=0.1))
    frame = _frame(index=7200, camera_time_s=(1 - drift) * 7200, host_time_s=7300.02, exposure_s=0.1)
    measured = path._completed(Measurement(frame, None, ""), None)
    # The fastest transfer, 10 ms, counts as none.
    assert measured.exposure_end_s == pytest.approx(100.0 + 7200 + 0.01, abs=0.011)


def test_lost_frames_are_counted_and_noted_with_the_next() -> None:
    path, made = FramePath((), Timings(), lambda _: False), list[Measurement]()
    for index in (0, 1, 4, 5, 2):  # the camera was restarted before the last
        frame = _frame(index=index, camera_time_s=float(index), host_time_s=100.0 + index, exposure_s=0.1)
        path._count(frame)
        made.append(path._completed(Measurement(frame, None, ""), None))
    assert [each.lost for each in made] == [0, 0, 2, 0, 2]
    assert [each.counts.lost for each in made] == [0, 0, 2, 2, 4]
    assert [each.counts.acquired for each in made] == [1, 2, 3, 4, 5]


def test_gap_before_a_restart_is_the_time_without_exposure() -> None:
    """The frame that arrives 3 s after the one before was itself exposed for 0.5 s."""
    path = FramePath((), Timings(), lambda _: False)
    for index, arrived_s in ((0, 100.0), (1, 101.0), (0, 104.0)):
        frame = _frame(index=index, camera_time_s=arrived_s, host_time_s=arrived_s, exposure_s=0.5)
        path._count(frame)
    gap = path._completed(Measurement(frame, None, ""), None).gap
    assert gap is not None
    assert gap.seconds == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("age_s", "exposure_s", "taken"),
    [(0.5, 0.01, 2), (2.5, 1.0, 2), (0.05, 0.01, 0), (0.5, 1.0, 0)],  # old: more than 0.1 s and than two exposures
)
def test_newest_frame_is_taken_if_the_next_is_old(
    monkeypatch: pytest.MonkeyPatch, age_s: float, exposure_s: float, taken: int
) -> None:
    monkeypatch.setattr("app.acquisition.frame_path.time", SimpleNamespace(perf_counter=lambda: 200.0))
    waiting = [
        _frame(index=index, camera_time_s=float(index), host_time_s=200.0 - age_s, exposure_s=exposure_s)
        for index in range(3)
    ]
    skipped = list[Measurement]()

    def read(_timeout_s: float) -> Frame:
        if not waiting:
            raise DeviceTimeout("no frame")
        return waiting.pop(0)

    camera = SimpleNamespace(read=read, exposure_s=exposure_s)
    instrument: Any = SimpleNamespace(
        devices=SimpleNamespace(camera=camera), skip=lambda frame: Measurement(frame, None, "skipped")
    )
    path = FramePath((skipped.append,), Timings(), lambda _: False)
    assert path._newest_frame(instrument, None).index == taken
    assert [each.frame.index for each in skipped] == list(range(taken))


def test_single_frame_before_the_first_of_the_camera_has_a_latency(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.acquisition.frame_path.time", SimpleNamespace(perf_counter=lambda: 200.0))
    made, timings = list[Measurement](), Timings()
    instrument: Any = SimpleNamespace(measure_single=measured_alone)
    path = FramePath((made.append,), timings, lambda _: False)
    path.process_single(
        _frame(index=0, camera_time_s=7.0, host_time_s=199.5, exposure_s=0.1), instrument, None, "dark.tif"
    )
    assert made[0].counts == FrameTotals(acquired=1, reconstructed=0)
    path.process_single(made[0].frame, instrument, None, "")  # of the recording that is played
    assert [each.problem for each in made] == ["foreign", ""]
    assert made[0].latency_s == timings.summary()["to_result"].max_s == pytest.approx(0.5)


def test_what_happened_before_a_frame_of_the_camera_did_not_happen_before_that_of_a_file() -> None:
    made = list[Measurement]()
    instrument: Any = SimpleNamespace(measure=lambda frame: Measurement(frame, None, ""), measure_single=measured_alone)
    path = FramePath((made.append,), Timings(), lambda _: False)
    frame = _frame(index=5, camera_time_s=0.0, host_time_s=100.0, exposure_s=0.1)
    for each in (frame, replace(frame, index=2)):  # after five and two lost ones, and a restart
        path._count(each)
        path.process(each, instrument, None)
    path.process_single(frame, instrument, None, "dark.tif")
    assert [each.lost for each in made] == [5, 2, 0]
    assert [each.gap is None for each in made] == [True, False, True]
    assert made[-1].counts == FrameTotals(acquired=3, lost=7)


def test_frame_of_a_routine_is_shown_with_its_time_and_not_counted() -> None:
    shown, taken = list[Measurement](), list[Measurement]()
    path = FramePath((taken.append,), Timings(), lambda _: False, shown.append)
    path.show(_frame(index=0, camera_time_s=0.0, host_time_s=100.0, exposure_s=0.1), "taking the dark", None)
    assert path.newest is shown[0]
    assert (shown[0].problem, shown[0].exposure_end_s, shown[0].counts) == ("taking the dark", 100.0, FrameTotals())
    assert not taken
