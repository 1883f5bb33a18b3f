"""`svwfs mask --accuracy`: predictions beside the full simulation, and files that are no masks."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run

from app.bench.config import load_bench
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames
from app.evaluation.mask_accuracy import calibration_of, linear_pass, lit_views, local_screen, predicted_accuracies
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.wavefront import mean_rms
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
    reconstructor = calibration_of(bench, reference, "affine").reconstructor()
    simulated = reconstructor.solve(reconstructor.register(frame.photons))
    predicted = reconstructor.solve(linear_pass(bench, reconstructor, reference)(frames.sample))
    error = mean_rms(simulated.views - frame.truth)
    assert error > 0.01  # what an affine warp cannot describe
    assert mean_rms(predicted.views - simulated.views) < 0.2 * error


@pytest.mark.slow
def test_noise_is_predicted_near_its_bound_and_falls_with_the_light(small_toml: Path) -> None:
    bench = load_bench(small_toml, ("simulation.source.mask='checkerboard'",))
    square, found = predicted_accuracies(bench, lambda *_: None).values()
    hidden = "displacements hidden in each lenslet"
    assert square[hidden] > 3 * found[hidden]
    for light in ("1000 e-", "1000 e- in the square"):
        assert 0.95 < found[f"noise, {light}: error bar"] / found[f"noise, {light}: bound"] < 1.15
        assert not square[f"noise, {light}: bound"] < 3 * found[f"noise, {light}: bound"]  # nan: not determined
    assert found["noise, 10000 e-: bound"] < found["noise, 300 e-: bound"] / 4
    assert found["noise, 300 e-: bound"] < found["noise, 300 e- in the square: bound"]  # a mask with less area
    assert found["residual, any wavefront"] < 0.5 * square["residual, any wavefront"]


@pytest.mark.slow
def test_accuracy_of_a_picture_is_printed_beside_the_square(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "grey.npy", np.linspace(0.5, 1, 16).reshape(4, 4))
    assert run(monkeypatch, "mask", tmp_path / "grey.npy", "--accuracy", "--bench", small_toml) == 0
    printed = capsys.readouterr().out
    assert "square   grey.npy" in printed
    assert re.search(r"light over the square's +1 +0\.\d+\b", printed)
    assert "residual, layers " in printed


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
def test_bad_mask_is_rejected(
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
    assert run(monkeypatch, "mask", str(file), "--accuracy") == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("square", "give --out FILE for a drawing, or --accuracy"),
        ("square --accuracy --size 1mm", "with --accuracy set simulation.source.half_width_m"),
        ("image --accuracy", "there is no mask and no file image"),
    ],
)
def test_mask_says_what_is_missing(
    words: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "mask", *words.split()) == 2
    assert said in capsys.readouterr().err


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
