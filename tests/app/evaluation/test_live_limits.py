"""The plan of the live-path benchmark, the limits of its figures, and its command."""

from __future__ import annotations

import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.gui_bench import BENCH
from support.posix import press_ctrl_c

import app.commands.benchmark
from app import cli
from app.bench.config import load_bench
from app.bench.device_kinds import RecordingSettings
from app.commands.benchmark import print_figures
from app.errors import InputError, Interrupted, ended_by
from app.evaluation.live_path import LiveFigures, LivePlan, Span, recording_folder, share
from app.measurement.measurement import FrameTotals
from app.recording.recorder import RecordingState
from app.timing import Timings

pytestmark = pytest.mark.usefixtures("restored_theme")  # the benchmark styles the application


def test_share_counts_lost_frames() -> None:
    assert share(FrameTotals(acquired=3, reconstructed=1, lost=5)) == 1 / 8
    assert math.isnan(share(FrameTotals()))


def span_of(
    *,
    redraws: int = 200,
    draw_s: float = 0.008,
    late_s: float = 0.02,
    written_s: float = 0.01,
    rate_hz: float = 70.0,
    **changes: Any,
) -> Span:
    """Return ten good seconds, with changes."""
    timings = Timings()
    for count, stage, seconds in ((redraws, "draw", draw_s), (1000, "to_result", late_s), (1000, "record", written_s)):
        for _ in range(count):
            timings.note(stage, seconds)  # type: ignore[arg-type] # each is a stage
    frames = FrameTotals(acquired=700, reconstructed=round(10 * rate_hz))
    how = {
        "first_wavefront_s": 4.9,
        "seconds": 10.0,
        "frames": frames,
        "memory_mb": ({"window": 800.0, "simulated rendering": 400.0}, {"window": 806.0}),
    }
    how["processor_s"] = {"window": 2.0, "instrument": 3.0}
    return Span(**{"times": timings.summary(), **how, **changes})


def figures_of(window: Span, bare: Span | None = None, problem: str = "", *, with_panels: bool = False) -> LiveFigures:
    state = RecordingState(Path("r"), "ended early" if problem else "finished", 700, 0, 10.0, problem)
    planned = LivePlan(bench=BENCH, seconds=10, record_in=Path(), with_panels=with_panels)
    return LiveFigures(
        plan=planned, is_seen=True, window=window, recording=state, bare=bare or span_of(), processor_s=20.0
    )


def test_good_run_misses_no_limit() -> None:
    figures = figures_of(span_of())
    assert figures.missed() == []
    assert len(figures.limits()) == 13
    assert figures.memory_growth == pytest.approx(0.0075)
    assert figures.window.redraw_s == 0.01


@pytest.mark.parametrize(
    ("name", "window"),
    [
        ("share", span_of(frames=FrameTotals(acquired=700, reconstructed=692))),
        ("lost", span_of(frames=FrameTotals(acquired=7000, reconstructed=7000, lost=1))),
        ("to_result_p99_s", span_of(late_s=0.031)),
        ("redrawn_hz", span_of(redraws=199)),
        ("draw_max_s", span_of(draw_s=0.101)),
        ("redraw_s", span_of(processor_s={"window": 2.5})),
        ("record_max_s", span_of(written_s=0.101)),
        ("memory_mb", span_of(memory_mb=({"window": 1000.0}, {"window": 1001.0}))),
        ("rate_ratio", span_of(frames=FrameTotals(acquired=660, reconstructed=660))),
        ("first_wavefront_s", span_of(first_wavefront_s=5.1)),
        ("memory_growth", span_of(memory_mb=({"window": 800.0}, {"window": 808.1}))),
    ],
)
def test_each_limit_is_missed_alone(name: str, window: Span) -> None:
    assert [line.split()[0] for line in figures_of(window).missed()] == [name]


def test_frames_may_be_skipped_with_panels() -> None:
    few = span_of(frames=FrameTotals(acquired=700, reconstructed=680))
    assert figures_of(few, few, with_panels=True).missed() == []


def test_processor_time_of_the_run_is_limited_by_its_duration() -> None:
    figures = figures_of(span_of())
    assert [line.split()[0] for line in replace(figures, processor_s=24.0).missed()] == ["processor_s"]
    assert replace(figures, plan=replace(figures.plan, seconds=20.0), processor_s=24.0).missed() == []
    assert len(replace(figures, processor_s=None).limits()) == 12


def test_early_end_of_recording_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    figures = figures_of(span_of(), problem="the disk is full")
    assert [line.split()[0] for line in figures.missed()] == ["recording_problems"]
    print_figures(figures)
    assert "The recording ended early: the disk is full" in capsys.readouterr().out


def test_empty_run_misses_limits_and_is_valid_json() -> None:
    empty = span_of(frames=FrameTotals(), times=Timings().summary(), memory_mb=({}, {}), processor_s={})
    figures = replace(figures_of(empty, empty), recording=None)
    names = {line.split()[0] for line in figures.missed()}
    assert names == {"share", "to_result_p99_s", "redrawn_hz", "draw_max_s", "rate_ratio"}
    assert json.loads(json.dumps(figures.tree(), allow_nan=False))["live"]["window"]["memory_mb"] == [{}, {}]
    print_figures(figures)


@pytest.mark.parametrize("seconds", [0.0, -5.0, 0.9, 3601.0, math.nan, math.inf])
def test_impossible_duration_is_rejected(seconds: float) -> None:
    with pytest.raises(InputError, match=r"--live .*: must be 1 \.\.\. 3600 seconds"):
        LivePlan(bench=BENCH, seconds=seconds, record_in=None)


def test_real_bench_is_rejected() -> None:
    with pytest.raises(InputError, match="simulated camera; this bench has recording"):
        LivePlan(bench=replace(BENCH, camera=RecordingSettings(folder="r")), seconds=10, record_in=None)


def test_recording_needs_room_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned = LivePlan(bench=load_bench("live_demo", ("camera.exposure_s=0.014286",)), seconds=600, record_in=tmp_path)
    assert 1 < planned.recording_bytes / (612 * 70 * 512 * 512 * 2) < 1.3
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=int(planned.recording_bytes) - 1))
    with (
        pytest.raises(InputError, match=r"takes up to [\d.]+ GB, and [\d.]+ GB are free.*--record-in"),
        recording_folder(planned, lambda *_: None),
    ):
        pass
    assert not list(tmp_path.iterdir())
    nowhere = replace(planned, record_in=tmp_path / "nowhere")
    with pytest.raises(InputError, match="no such folder"), recording_folder(nowhere, lambda *_: None):
        pass
    with recording_folder(replace(planned, record_in=None), lambda *_: None) as folder:
        assert folder is None


def test_second_interrupt_still_removes_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned = LivePlan(bench=BENCH, seconds=1, record_in=tmp_path)
    remove = shutil.rmtree

    def remove_interrupted(path: Path) -> None:
        press_ctrl_c()
        remove(path)

    def interrupt(_number: int, _frame: object) -> None:
        raise Interrupted

    monkeypatch.setattr(shutil, "rmtree", remove_interrupted)
    with ended_by(interrupt), pytest.raises(Interrupted), recording_folder(planned, lambda *_: None):
        raise Interrupted
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--live", "0"], "--live 0: must be 1 ... 3600 seconds"),
        (["--live", "5", "--record-in", "nowhere"], "nowhere: no such folder"),
        (["--no-record"], "--live SECONDS"),
        (["--rendered"], "--live SECONDS"),
        (["--live", "5", "--camera-rate", "3000"], "--camera-rate"),
        (["--set", "camera.exposure_s=0.02"], "--live SECONDS"),
    ],
)
def test_command_rejects_impossible_options(
    options: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    monkeypatch.setattr(sys, "argv", ["svwfs", "benchmark", *options])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_camera_rate_changes_exposure_and_light_together(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    plans: list[LivePlan] = []

    def measured(planned: LivePlan, _report: object) -> LiveFigures:
        plans.append(planned)
        return figures_of(span_of())

    monkeypatch.setattr(app.commands.benchmark, "benchmark_acquisition", measured)
    options = ["--live", "5", "--camera-rate", "350", "--rendered", "--record-in", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["svwfs", "benchmark", *options])
    with pytest.raises(SystemExit):
        cli.main()
    (planned,) = plans
    camera, light = planned.bench.camera_model, planned.bench.light_model
    assert 1 / camera.exposure_s == pytest.approx(350, rel=1e-3)
    assert camera.noise_frames > 0
    assert light.current_a * camera.exposure_s == pytest.approx(0.35 / 70, rel=1e-3)


@pytest.mark.parametrize(("late_s", "status"), [(0.02, 0), (0.04, 1)])
def test_command_measures_70_hz_prints_writes_and_checks(
    late_s: float, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plans: list[LivePlan] = []

    def measured(planned: LivePlan, _report: object) -> LiveFigures:
        plans.append(planned)
        return figures_of(span_of(late_s=late_s))

    monkeypatch.setattr(app.commands.benchmark, "benchmark_acquisition", measured)
    options = ["--live", "60", "--record-in", str(tmp_path), "--json", str(tmp_path / "live.json"), "--check"]
    monkeypatch.setattr(sys, "argv", ["svwfs", "benchmark", *options, "--set", "camera.em_gain=8"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == status
    (planned,) = plans
    camera = planned.bench.camera_model
    assert 1 / camera.exposure_s == pytest.approx(70, abs=0.1)
    assert (camera.rows, camera.columns) == (512, 512)
    assert (camera.em_gain, planned.bench.reconstruction.refine) == (8, False)
    assert (planned.seconds, planned.record_in) == (60, tmp_path)
    assert json.loads((tmp_path / "live.json").read_text())["live"]["limits"]["share"]["is_met"]
    said = capsys.readouterr()
    assert "frames acquired" in said.out
    assert said.err == ("" if status == 0 else "svwfs: missed: to_result_p99_s is 0.04, asked <= 30.0 ms\n")
