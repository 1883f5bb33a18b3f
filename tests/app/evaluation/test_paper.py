"""The paper's tables: files, order of the methods, and benches that cannot run them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run
from support.pictures import assert_drawn

from app.bench.config import load_bench
from app.evaluation.paper import METHODS, FramePair, resized

COARSE = ("simulation.object_samples=13", "simulation.pupil_samples=10")
QUICK_SCREEN = "simulation.screen.sample_spacing_m=20e-6"  # rendering the experiment's own takes seconds


def table(monkeypatch: pytest.MonkeyPatch, out: Path, name: str, *more: str) -> dict[str, Any]:
    """Run `svwfs paper NAME` on a coarse bench and return what it wrote."""
    settings = [word for change in COARSE for word in ("--set", change)]
    assert run(monkeypatch, "paper", name, "--out", out, *settings, *more) == 0
    written: dict[str, Any] = json.loads((out / f"{name}.json").read_text())
    return written


def only(monkeypatch: pytest.MonkeyPatch, *methods: str) -> None:
    """Leave out the other methods, some of which take seconds a frame."""
    monkeypatch.setattr("app.evaluation.paper.METHODS", {name: METHODS[name] for name in methods})


@pytest.mark.slow
@pytest.mark.long
def test_table_1_orders_the_methods_like_the_paper(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written = table(monkeypatch, tmp_path, "table1")
    ours = written["ours"]
    assert written["paper"]["stars_zonal"] == {"min_rad": 0.108, "max_rad": 0.197, "mean_rad": 0.147}
    assert written["paper"]["shift_zonal"]["mean_rad"] == 0.830
    assert set(ours) == {name for name, method in METHODS.items() if not method.is_peer}
    assert all(row["min_rad"] <= row["mean_rad"] <= row["max_rad"] for row in ours.values())
    mean = {name: row["mean_rad"] for name, row in ours.items()}
    assert mean["quadratic_modal"] < mean["affine_modal"] < mean["block_flow_zonal"] < mean["shift_zonal"]
    assert 0.7 < mean["shift_zonal"] < 1.7
    assert mean["stars_zonal"] < 0.15
    real = {name: row["mean_rad"] for name, row in written["in_real_light"].items()}
    assert set(real) == set(ours)
    assert max(mean["automatic"], real["automatic"]) < 0.05
    assert real["affine_modal"] > 1.2 * mean["affine_modal"]
    assert_drawn(tmp_path / "table1.png")
    assert re.search(r"shift_zonal\s+0\.511\s+1\.260\s+0\.830\s+\d", capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.long
def test_seeds_are_averaged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    only(monkeypatch, "affine_modal")
    one = table(monkeypatch, tmp_path / "1", "table1")["ours"]["affine_modal"]
    two = table(monkeypatch, tmp_path / "2", "table1", "--seeds", "2")["ours"]["affine_modal"]
    other = table(monkeypatch, tmp_path / "3", "table1", "--set", "simulation.seed=2")["ours"]["affine_modal"]
    assert one["spread_rad"] == 0
    assert two["mean_rad"] == pytest.approx((one["mean_rad"] + other["mean_rad"]) / 2)
    assert two["spread_rad"] == pytest.approx(abs(one["mean_rad"] - other["mean_rad"]) / np.sqrt(2))


@pytest.mark.slow
@pytest.mark.long
def test_table_2_orders_the_methods_like_the_paper(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ours = table(monkeypatch, tmp_path, "table2", "--set", QUICK_SCREEN)["ours"]
    assert ours["stars_zonal_against_truth"]["mean_rad"] < 0.2
    assert ours["quadratic_zonal"]["mean_rad"] < ours["affine_zonal"]["mean_rad"] < ours["shift_zonal"]["mean_rad"]
    assert 3 < ours["shift_zonal"]["mean_rad"] < 12
    assert "affine_zonal_resized" in ours


@pytest.mark.slow
@pytest.mark.long
def test_stars_follow_the_spacing_of_the_bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    only(monkeypatch, "stars_zonal")
    ours = table(monkeypatch, tmp_path, "table1", "--set", "simulation.source.star_spacing_m=0.45e-3")["ours"]
    assert ours["stars_zonal"]["mean_rad"] < 0.15


@pytest.mark.slow
@pytest.mark.long
def test_circular_field_counts_only_views_inside(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    only(monkeypatch, "affine_modal", "quadratic_modal")
    written = table(monkeypatch, tmp_path, "table1", "--set", "field.shape=circle")
    assert written["problems"] == {}
    assert written["ours"]["quadratic_modal"]["mean_rad"] < 0.12


@pytest.mark.parametrize(
    ("change", "sentence"),
    [("camera.readout_speed=3", "need another amplifier or readout_speed"), ("camera.exposure_s=9999.0", "exposure_s")],
)
def test_bench_unable_to_run_the_experiment_is_rejected(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str, sentence: str
) -> None:
    settings = [word for each in (change, QUICK_SCREEN, *COARSE) for word in ("--set", each)]
    assert run(monkeypatch, "paper", "table2", "--out", tmp_path, *settings) == 2
    assert sentence in capsys.readouterr().err


def test_sources_refuses_the_slow_methods(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "paper", "sources", "--peers", "--out", tmp_path) == 2
    assert "--peers" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.long
def test_sources_compares_all_shapes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ours = table(monkeypatch, tmp_path, "sources")["ours"]
    assert len(ours) == 5 * 6
    assert ours["octagon_quadratic_modal"]["mean_rad"] < 0.3


def test_crop_and_resize_keeps_the_lattice_centred() -> None:
    bench = load_bench("paper_experiment")
    y, x = np.meshgrid(np.arange(512), np.arange(512), indexing="ij")
    cells = (np.cos((x - 255.5) * 2 * np.pi / 31.25) + np.cos((y - 255.5) * 2 * np.pi / 31.25)).astype(np.float32)
    small_bench, small = resized(bench, {"square": FramePair(cells, cells)})
    assert small["square"].frame.shape == (465, 465)
    assert small_bench.sensor.lenslet_pitch_px == pytest.approx(31)
    assert small_bench.lattice is not None
    centers = small_bench.lattice.lenslet_centers_px(15, 15).reshape(-1, 2)
    at_centers = small["square"].frame[np.rint(centers[:, 1]).astype(int), np.rint(centers[:, 0]).astype(int)]
    assert at_centers.min() > 1.9  # crests; half a pixel off like the paper's crop
