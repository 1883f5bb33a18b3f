"""`svwfs calibrate`: lattice, text, plot, bench file, and refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from support.command_line import run
from support.lattice_frames import draw, image_of, photographed
from support.paths import FOREIGN_FRAMES as FRAMES
from support.pictures import assert_drawn

from app.bench.config import load_bench, parse_bench
from app.bench.presets import PRESETS
from app.commands.calibrate import bench_text, calibrate_bench, differences, summary, write_found
from app.results.figures import lattice_figure
from reconstruction.geometry import Lattice
from reconstruction.lattice.cells import cell_index

BENCH = FRAMES / "bench.toml"
TRUTH = Lattice(center_x_px=262.4, center_y_px=249.1, pitch_px=30.7, rotation_rad=0.03)
DEAD = (4, 9)  # lenslet row and column


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Noisy reference of 15 x 15 lenslets, one of them dead."""
    brightness = np.ones((15, 15))
    brightness[DEAD] = 0
    light = draw(
        (512, 512),
        center_px=(TRUTH.center_x_px, TRUTH.center_y_px),
        pitch_px=TRUTH.pitch_px,
        rotation_rad=TRUTH.rotation_rad,
        brightness=brightness,
        image_px=image_of("square", TRUTH.pitch_px, 0.3, 1.2),
    )
    path = tmp_path_factory.mktemp("calibrate") / "reference.tif"
    tifffile.imwrite(path, photographed(light, np.random.default_rng(0), peak_e=2000))
    return path


def command(reference: Path, *more: str | Path) -> tuple[str | Path, ...]:
    return "calibrate", reference, "--bench", BENCH, *more


@pytest.mark.slow
@pytest.mark.long
def test_written_bench_has_lattice_and_comments(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, reference: Path
) -> None:
    source, out, plot = tmp_path / "bench.toml", tmp_path / "new" / "bench.toml", tmp_path / "p.png"
    source.write_text(f"# my bench\n{BENCH.read_text()}# the end\n")
    assert run(monkeypatch, "calibrate", reference, "--bench", source, "--out", out, "--plot", plot) == 0
    bench = load_bench(out)
    assert bench.lattice is not None
    assert (bench.lattice.center_x_px, bench.lattice.center_y_px) == pytest.approx((262.4, 249.1), abs=0.05)
    assert bench.lattice.pitch_px == pytest.approx(30.7, abs=0.01)
    assert bench.lattice.rotation_rad == pytest.approx(0.03, abs=1e-4)
    assert "# my bench" in out.read_text()
    assert "# the end" in out.read_text()
    assert load_bench(source).sensor == bench.sensor
    assert_drawn(plot)
    said = capsys.readouterr()
    assert "224 of 225" in said.out
    assert "pitch is -1.8 % off the design" in said.err


def test_json_option_prints_figures_and_differences(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], reference: Path
) -> None:
    assert run(monkeypatch, *command(reference, "--json", "--set", "sensor.lenslet_rows=13")) == 0
    said = capsys.readouterr()
    figures = json.loads(said.out)
    assert not said.err
    assert figures["pitch_px"] == pytest.approx(30.7, abs=0.01)
    assert (figures["whole_rows"], figures["whole_columns"]) == (15, 15)
    assert (figures["lenslets"], figures["illuminated"]) == (195, 194)
    assert any("lenslet_rows = 13" in sentence for sentence in figures["differences"])


def test_dark_is_subtracted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, reference: Path) -> None:
    pattern = 3000 * np.sin(2 * np.pi * np.indices((512, 512))[1] / 30.7) ** 2
    spoilt, dark, out = tmp_path / "r.tif", tmp_path / "d.tif", tmp_path / "b.toml"
    tifffile.imwrite(spoilt, (tifffile.imread(reference) + pattern).astype(np.float32))
    tifffile.imwrite(dark, (500 + pattern).astype(np.float32))
    assert run(monkeypatch, *command(spoilt, "--dark", dark, "--out", out)) == 0
    lattice = load_bench(out).lattice
    assert lattice is not None
    assert lattice.center_x_px == pytest.approx(262.4, abs=0.05)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda _: np.random.default_rng(0).normal(500, 8, (512, 512)).astype(np.float32), "shows no lattice"),
        (lambda image: np.minimum(image.astype(np.float64) * 90, 65535).astype(np.uint16), "is saturated"),
        (lambda image: image[:40], "not even 2 x 2 lenslets of 31.3 px fit on 40 x 512 pixels"),
        (lambda image: np.where(image > 0, np.float32(np.nan), 0), "not finite"),
    ],
)
def test_reference_without_lattice_exits_with_status_2(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    reference: Path,
    make: object,
    sentence: str,
) -> None:
    bad, out, plot = tmp_path / "bad.tif", tmp_path / "b.toml", tmp_path / "p.png"
    tifffile.imwrite(bad, make(tifffile.imread(reference)))  # type: ignore[operator] # one of the functions above
    assert run(monkeypatch, *command(bad, "--out", out, "--plot", plot)) == 2
    errors = capsys.readouterr().err
    assert errors.startswith(f"svwfs: {bad}: ")
    assert sentence in errors
    assert errors.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"bad.tif"}


def test_dark_of_other_size_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, reference: Path
) -> None:
    dark = tmp_path / "dark.npy"
    np.save(dark, np.zeros((10, 10)))
    assert run(monkeypatch, *command(reference, "--dark", dark)) == 2
    assert capsys.readouterr().err.startswith(f"svwfs: {dark}: the dark has another size")


def test_impossible_pitch_is_explained(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, reference: Path
) -> None:
    text, bench = BENCH.read_text(), tmp_path / "bench.toml"
    bench.write_text(text[: text.index("[lattice]")] + text[text.index("[field]") :])
    settings = ("--bench", bench, "--set", "sensor.pixel_pitch_m=18.4e-6")
    assert run(monkeypatch, "calibrate", reference, *settings) == 2
    errors = capsys.readouterr().err
    assert "lattice.pitch_px = 30.7" in errors
    assert "check the sensor's lenslet_pitch_m and pixel_pitch_m" in errors


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_accepts_lattice_and_keeps_text(preset: str) -> None:
    text, before = PRESETS[preset].read_text(), load_bench(preset)
    lattice = Lattice(center_x_px=120.5, center_y_px=119.25, pitch_px=31.25, rotation_rad=0.0125)
    bench = replace(before, lattice=lattice)
    edited = bench_text(text, bench)
    assert parse_bench(edited, preset) == bench
    assert bench != before
    kept = [line for line in text.splitlines() if line.startswith(("#", "[sim", "seed", "[field]"))]
    assert all(line in edited.splitlines() for line in kept)


def test_unusual_lattice_notation_is_rewritten() -> None:
    text = BENCH.read_text()
    start, end = text.index("[lattice]"), text.index("[field]")
    inline = "lattice = { center_x_px = 1.0, center_y_px = 2.0, pitch_px = 31.0 }\n" + text[:start] + text[end:]
    bench = parse_bench(text, "bench")
    assert parse_bench(bench_text(inline, bench), "new") == bench
    without = text[:start] + text[end:]
    assert parse_bench(bench_text(without, bench), "new") == bench
    changed = parse_bench(text, "bench", ("registration.warp=affine",))
    assert parse_bench(bench_text(text, changed), "new") == changed


def test_preset_is_written_with_lattice(tmp_path: Path) -> None:
    found = calibrate_bench(FRAMES / "square_reference.tif", dark=None, bench=load_bench("live_demo"))
    write_found(found.bench, "lattice", "live_demo", tmp_path / "b.toml")
    assert load_bench(tmp_path / "b.toml") == found.bench
    assert not differences(found)
    assert "-0.000" not in " ".join(summary(found))


def test_full_frame_lattice_has_no_cut_cells() -> None:
    """Rounding of the outermost edges must not matter."""
    lattice = Lattice(center_x_px=232.0, center_y_px=232.0, pitch_px=31.0 - 1e-6, rotation_rad=1e-7)
    assert len(cell_index(lattice, (465, 465))) == 15 * 15
    assert len(cell_index(lattice, (465, 465), only_partial=True)) == 0
    assert len(cell_index(lattice, (475, 465), only_partial=True)) == 15


def test_lattice_plot_marks_lit_dark_outside_and_cut_lenslets(reference: Path) -> None:
    found = calibrate_bench(reference, dark=None, bench=load_bench(str(BENCH), ("sensor.lenslet_rows=12",)))
    figure = lattice_figure(found.reference, found.survey)
    labels = [str(text.get_text()) for text in figure.legends[0].get_texts()]
    count = {label.partition(" ")[2]: int(label.partition(" ")[0]) for label in labels if label[0].isdigit()}
    assert count["with light"] + count["dark"] == 12 * 15
    assert count["dark"] == 1
    assert count["whole, not among the sensor's lenslets"] >= 3 * 15
    assert count["cut by the frame's edge"] > 30
    assert "179 of the sensor's 180 with light" in figure.get_suptitle()
    dark = next(cells for cells in figure.axes[0].collections if str(cells.get_label()) == "1 dark")
    middle = np.asarray(dark.get_paths()[0].vertices)[:4].mean(axis=0)
    y, x = np.array(DEAD) - 7
    assert middle == pytest.approx(TRUTH.to_camera_px(np.array([x, y]) * TRUTH.pitch_px), abs=0.1)


def linearity(*more: str | Path) -> tuple[str | Path, ...]:
    return "calibrate", "--linearity", "--average", "2", *more


@pytest.mark.slow
def test_linearity_is_measured_with_the_devices_and_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    source, out = tmp_path / "bench.toml", tmp_path / "linear.toml"
    source.write_text("# mine\n" + small_toml.read_text().replace("[camera]", "[camera]\nnonlinearity = 0.05"))
    assert run(monkeypatch, *linearity("--bench", source, "--out", out)) == 0
    found = load_bench(out)
    assert "# mine" in out.read_text()
    assert "[linearity] # found by svwfs calibrate" in out.read_text()
    assert replace(found, linearity=None) == load_bench(source)
    assert found.linearity is not None
    assert found.linearity.amplifier == "em"
    share = 0.05 * found.linearity.highest_counts / 65535
    light_over_signal = (1 - np.sqrt(1 - 4 * share)) / (2 * share)  # of S = L - b L^2
    assert found.linearity.quadratic + found.linearity.cubic == pytest.approx(light_over_signal - 1, abs=1e-3)
    assert "quadratic    +0.0" in capsys.readouterr().out
    again = tmp_path / "again.toml"
    assert run(monkeypatch, *linearity("--bench", out, "--out", again, "--json")) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["linearity"]["quadratic"] == pytest.approx(found.linearity.quadratic, abs=5e-3)
    assert again.read_text().count("[linearity]") == 1  # in place of the other


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("reference.tif", "--linearity"), "leave reference, --dark and --plot out"),
        (("--linearity", "--plot", "p.png"), "leave reference, --dark and --plot out"),
        ((), "give the reference frame"),
        (("reference.tif", "--average", "4"), "--average belongs to --linearity"),
        (("--linearity", "--out", "b.txt"), "b.txt"),
        (("--linearity", "--set", "light.driver=manual"), "light.driver"),
    ],
)
def test_options_of_lattice_and_linearity_are_kept_apart(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], sentence: str
) -> None:
    assert run(monkeypatch, "calibrate", *arguments, "--bench", "small_demo") == 2
    assert sentence in capsys.readouterr().err
