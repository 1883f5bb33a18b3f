"""`svwfs study mask`: predictions beside the full simulation, and files that are no masks."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from support.command_line import run

from app.bench.config import load_bench
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, with_source
from app.evaluation.study.estimators import mean_rms_within, warp_estimator
from app.evaluation.study.masks import LinearPass, local_screen, many_masks_study, mask_study
from app.evaluation.study.sweeps import lit_views
from reconstruction.modes.field_modes import LegendreModes
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.optics.screen_light import RayMap, ScreenLight
from simulated_devices.sample import Sample


def test_local_screen_adds_up_to_the_screen(small_toml: Path) -> None:
    bench, modes = load_bench(small_toml), LegendreModes(21)
    along_m = (np.arange(101) - 50) * 0.1e-3
    y, x = np.meshgrid(along_m * 1e3, along_m * 1e3, indexing="ij")
    screen = PhaseScreen(0.3 * x**2 * y - y**3 + x * y + 2 * x, 0.1e-3)  # splines are exact for cubics
    rays = RayMap(pupil_scale=0.9, field_scale=0.8)
    sample = Sample(
        sensor=bench.sensor,
        field=bench.field,
        screen=screen,
        amplitude=None,
        ray_map=rays,
        light=ScreenLight(screen, None, rays),
    )
    local = local_screen(sample, bench, modes).reshape(5, 7, 6, 6, 21)
    xi, eta, x_field, y_field = np.random.default_rng(1).uniform(-1, 1, (4, 20))
    of_field = modes.values(x_field, y_field)
    for row, column in ((0, 0), (4, 5), (2, 3)):
        products = np.polynomial.legendre.legval2d(eta, xi, np.eye(36).reshape(6, 6, 36))  # (n m, position)
        found = np.einsum("kq,kp,qp->p", local[row, column].reshape(36, 21), products, of_field)
        x_m = 0.9 * (bench.sensor.pupil_x_m[column] + xi * 0.25e-3) + 0.8 * 0.6e-3 * x_field
        y_m = 0.9 * (bench.sensor.pupil_y_m[row] + eta * 0.25e-3) + 0.8 * 0.6e-3 * y_field
        assert found == pytest.approx(screen.at(x_m, y_m), abs=1e-4)  # the spline's basis is float32


@pytest.mark.parametrize(("light", "mask"), [("neglected", "square"), ("real", "checkerboard"), ("real", "square")])
def test_linear_pass_predicts_the_error_of_the_simulated_one(small_toml: Path, light: str, mask: str) -> None:
    screen = ("simulation.screen.rms_rad=0.2", "simulation.screen.correlation_length_m=1e-3")
    neglect = f"field.neglect_propagation={str(light == 'neglected').lower()}"
    bench = load_bench(small_toml, (*screen, neglect, f"simulation.source.mask='{mask}'"))
    frames = NoiseFreeFrames(bench)
    frame, reference = frames.frame(mask), frames.reference(mask)
    reconstructor = warp_estimator(bench, reference, "affine").reconstructor
    simulated = reconstructor.solve(reconstructor.register(frame.photons))
    predicted = reconstructor.solve(LinearPass(bench, reconstructor, reference)(frames.sample))
    everywhere = np.ones((5, 7), np.bool_)
    error = mean_rms_within(simulated.views - frame.truth, everywhere)
    assert error > 0.01  # what an affine warp cannot describe
    assert mean_rms_within(predicted.views - simulated.views, everywhere) < 0.2 * error


def studied(out: Path, monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> dict[str, dict[str, float]]:
    """Results of `svwfs study mask` by curve and mask."""
    assert run(monkeypatch, "study", "mask", *words, "--seeds", "1", "--out", out) == 0
    curves = json.loads((out / "study.json").read_text())["sweeps"]["mask"]["curves"]
    return {
        name: {Path(str(point["at"])).name: point["mean_rad"] for point in points if "mean_rad" in point}
        for name, points in curves.items()
    }


@pytest.mark.slow
@pytest.mark.long
def test_mask_study_predicts_the_simulation_without_propagation(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    y, x = np.mgrid[-1:1:60j, -1:1:60j]
    file = tmp_path / "four.npy"
    np.save(file, (np.hypot(abs(x) - 0.5, abs(y) - 0.5) > 0.3).astype(np.float32))
    settings = ("--bench", small_toml, "--set", "field.neglect_propagation=true")
    found = studied(tmp_path / "out", monkeypatch, file, "circle", *settings)
    masks = ["square (1.00; 0)", "four.npy (0.73; 0)", "circle (0.78; 2)"]  # 1 - 0.09 pi and pi / 4 on 13 x 13 points
    assert list(found["residual, any wavefront: simulated"]) == masks
    for mask in masks:
        for light in ("1000 e-", "1000 e- in the square"):
            bound, predicted, simulated = (
                found[f"noise, {light}: {row}"][mask] for row in ("bound", "predicted", "simulated")
            )
            assert 0.99 < predicted / bound < 1.1
            assert simulated == pytest.approx(predicted, rel=0.1)
    square = masks[0]
    assert found["noise, 10000 e-: bound"][square] < found["noise, 300 e-: bound"][square] / 4
    assert found["noise, 10000 e-: predicted"][square] < found["noise, 300 e-: predicted"][square] / 3
    assert found["noise, 300 e-: bound"][square] == found["noise, 300 e- in the square: bound"][square]
    assert "residual, layers: predicted" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.long
def test_mask_study_tells_what_the_square_hides_in_real_light(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path
) -> None:
    found = studied(tmp_path / "out", monkeypatch, "checkerboard", "--bench", small_toml)
    square, checkerboard = found["residual, layers: simulated"]
    hidden = [int(mask.split("; ")[1][:-1]) for mask in (square, checkerboard)]
    assert hidden[0] > 3 * hidden[1]
    noise = found["noise, 1000 e-: bound"]
    assert noise.get(square, np.inf) > 3 * noise[checkerboard]
    assert 0.95 < found["noise, 1000 e-: predicted"][checkerboard] / noise[checkerboard] < 1.15
    assert found["noise, 1000 e-: simulated"][checkerboard] == pytest.approx(noise[checkerboard], rel=0.15)
    residual = found["residual, any wavefront: simulated"]
    assert residual[checkerboard] < 0.5 * residual[square]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "there is no mask and no file"),
        (b"", "is not a readable image"),
        (b"no image", "is not a readable image"),
        (np.zeros((4, 4)), "not all of it 0"),
        (np.full((4, 4), np.nan), "finite brightness"),
        (np.ones((4, 4, 4)), "one grey image"),
    ],
)
def test_bad_mask_is_rejected_before_computing(
    content: bytes | np.ndarray | None,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / ("mask.npy" if isinstance(content, np.ndarray) else "mask.png")
    if isinstance(content, np.ndarray):
        np.save(file, content)
    elif content is not None:
        file.write_bytes(content)
    assert run(monkeypatch, "study", "mask", str(file), "--out", str(tmp_path / "out")) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["checkerboard:1", "checkerboard:101", "checkerboard:" + "9" * 5000])
def test_checkerboard_needs_cells_within_the_limits(name: str) -> None:
    with pytest.raises(InputError, match=f"mask {name}: (checker_cells must be 2 ... 100|Exceeds the limit)"):
        mask_study([name])


def test_cells_of_a_checkerboard_follow_its_name(small_toml: Path) -> None:
    sources = cast("partial[Any]", mask_study(["checkerboard", "checkerboard:5"]).measure).keywords["sources"]
    drawn = [with_source(load_bench(small_toml), **changes).simulation.source for changes in sources.values()]
    assert [(source.mask, source.checker_cells) for source in drawn] == [
        ("square", 6),
        ("checkerboard", 6),
        ("checkerboard", 5),
    ]


def test_mask_study_needs_a_mask(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "study", "mask", "--out", str(tmp_path / "out")) == 2
    assert "svwfs study mask FILE..., or square, stars, checkerboard, optimised, circle" in capsys.readouterr().err


def test_views_inside_the_outline_of_the_source_count(tmp_path: Path, small_toml: Path) -> None:
    bench = load_bench(small_toml)

    def lit(**changes: Any) -> np.ndarray:
        source = replace(bench.simulation.source, **changes)
        return lit_views(replace(bench, simulation=replace(bench.simulation, source=source)))

    assert lit(mask="square").all()
    assert lit(mask="circle").tolist() == [[False, True, False], [True, True, True], [False, True, False]]
    assert lit(mask="ellipse", ellipse_ratio=0.6).tolist() == [[False] * 3, [True] * 3, [False] * 3]
    ring, between, point = np.zeros((12, 12)), np.zeros((12, 12)), np.zeros((13, 13))
    ring[0] = ring[-1] = ring[:, 0] = ring[:, -1] = 1
    between[7:10, 7:10] = 1  # 0.1 ... 0.4 mm; the views lie at 0 and 0.5 mm
    point[6, 6] = 1
    file = str(tmp_path / "mask.npy")
    np.save(file, ring)
    assert lit(mask="image", file=file).all()
    np.save(file, between)
    assert not lit(mask="image", file=file).any()
    np.save(file, point)
    with pytest.raises(InputError, match="a point or a line"):
        lit(mask="image", file=file)


@pytest.mark.slow
@pytest.mark.long
def test_many_masks_are_compared_as_the_study_of_each_predicts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / "notes.txt").write_text("no picture")
    cells = (np.indices((5, 5)).sum(axis=0) % 2 == 0).astype(np.float32)
    np.save(folder / "fine.npy", cells)
    np.save(folder / "small.npy", np.pad(cells, 1))  # lights the view in the middle alone
    np.save(folder / "between.npy", np.eye(9, dtype=np.float32)[[2]] * np.eye(9, 1, dtype=np.float32))  # the views
    words = ("study", "masks", "checkerboard:5", folder, "--bench", small_toml, "--seeds", "1", "--out", tmp_path / "o")
    assert run(monkeypatch, *words) == 0
    printed = capsys.readouterr().out
    assert "between.npy: " in printed
    found = {Path(row["mask"]).name: row for row in json.loads((tmp_path / "o" / "masks.json").read_text())["masks"]}
    assert set(found) == {"checkerboard:5", "fine.npy", "small.npy", "square"}
    assert list(found)[-1] == "square"  # which hides the most
    named, picture = ({**found[name], "mask": 0.0} for name in ("checkerboard:5", "fine.npy"))
    assert named == pytest.approx(picture, rel=1e-3)
    assert found["small.npy"]["bound_1000_rad"] > 1.5 * found["fine.npy"]["bound_1000_rad"]  # in all views
    alone = studied(tmp_path / "alone", monkeypatch, "checkerboard:5", "--bench", small_toml)
    (key,) = (name for name in alone["noise, 1000 e- in the square: bound"] if name.startswith("checkerboard"))
    for peak_e in (300, 1000, 10000):
        bound = alone[f"noise, {peak_e} e- in the square: bound"][key]
        assert named[f"bound_{peak_e}_rad"] == pytest.approx(bound, rel=1e-3)
    assert (tmp_path / "o" / "masks.csv").exists()
    assert (tmp_path / "o" / "masks.png").exists()


def test_figure_of_three_masks_keeps_their_marks_inside() -> None:
    study = many_masks_study(["optimised", "checkerboard"])
    rows = {"mask": ["square", "optimised", "checkerboard"], "light": [1.0, 0.44, 0.5]}
    errors = ("bound_300_rad", "bound_1000_rad", "bound_10000_rad", "bias_bench_rad", "bias_source_rad")
    figure = study.figure(pd.DataFrame(rows | {error: [1.0, 0.02, 0.03] for error in errors}))
    figure.draw_without_rendering()
    for panel in figure.axes:
        assert [text.get_text() for text in panel.texts] == ["1", "2", "3"]
        for text in panel.texts:
            place = text.get_window_extent()
            assert panel.bbox.contains(place.x0, place.y0)
            assert panel.bbox.contains(place.x1, place.y1)
        assert panel.get_xlabel().splitlines()[1:] == ["1  optimised", "2  checkerboard", "3  square"]


def test_folder_without_pictures_is_no_mask(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "study", "masks", str(tmp_path), "--out", str(tmp_path / "out")) == 2
    assert "holds no picture of a mask" in capsys.readouterr().err
