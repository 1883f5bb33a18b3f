"""The commands of docs/first_measurement.md, run on a small bench with short exposures."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import xarray as xr
from support.command_line import run
from support.gui_bench import FakeCamera, opener
from support.manual_bench import MANUAL, Person
from support.paths import DOCS, SMALL_TOML
from support.pictures import assert_drawn

import app.bench.presets
from app.bench.config import load_bench, parse_bench
from app.commands.measure import measure_bench
from app.errors import Interrupted
from app.measurement.averages import FRAMES
from app.recording.reader import Recording
from drivers.stage import ManualStage
from simulated_devices.settings import exposure_range_s

TEXT = (DOCS / "first_measurement.md").read_text("utf-8")
OWN_SENSOR, CAMERA = ((DOCS / name).read_text("utf-8") for name in ("own_sensor.md", "devices_hamamatsu.md"))
SMALL = SMALL_TOML.replace("em_gain = 8.0", "readout_speed = 2").replace("exposure_s = 0.02", "exposure_s = 0.03")
QUICK = {  # fewer lenslets and less time than in the text
    "camera.exposure_s=3.8": "camera.exposure_s=0.45",
    "--frames 20": "--frames 2",
    "--frames 3": "--frames 2",
    "pupil_modes=45": "pupil_modes=10",
}


def commands() -> list[tuple[str, str]]:
    """Every command of the text, with the next line."""
    joined = TEXT.replace("\\\n", " ")
    found = re.findall(r"^    svwfs ([^:\n]\S+ .+)\n(?=(.*)$)", joined, re.MULTILINE)
    return [(" ".join(command.split()), after.strip()) for command, after in found]


def quick(command: str) -> str:
    """Adapt a command to the small bench."""
    for long, short in QUICK.items():
        command = command.replace(long, short)
    if command.startswith("measure") and "--average" not in command:
        command += " --average 4"
    return command


@pytest.mark.slow
@pytest.mark.long
def test_every_documented_command_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "paper_experiment.toml").write_text(SMALL)
    monkeypatch.setitem(app.bench.presets.PRESETS, "paper_experiment", tmp_path / "paper_experiment.toml")
    monkeypatch.chdir(tmp_path)
    assert len(commands()) >= 14
    residuals_rad: dict[str, tuple[float, ...]] = {}
    for command, after in commands():
        is_refused = after.startswith("svwfs: ")
        words = shlex.split(command if is_refused else quick(command))
        assert run(monkeypatch, *words) == (2 if is_refused else 0), command
        shown = capsys.readouterr()
        if is_refused:
            assert shown.err.strip() == after
        elif command.startswith("compare"):
            residuals_rad[command] = tuple(map(float, re.findall(r"\d+\.\d{3}", shown.out)[-3:]))
        elif "--verify" in command:
            assert shown.out.startswith("2 frames as recorded: ")
    assert len(residuals_rad) == len(set(residuals_rad.values())) == 4  # every method leaves another residual
    assert all(0 < least < mean < most for least, most, mean in residuals_rad.values())
    stars, square = (Recording(tmp_path / name) for name in ("stars", "square"))
    assert (len(stars), len(square)) == (2, 2)
    assert [each.bench.simulation.source.mask for each in (stars, square)] == ["stars", "square"]
    assert [each.run["devices"]["stage"]["mask"] for each in (stars, square)] == ["stars", "square"]
    assert [each.calibration(0).reference.amplifier for each in (stars, square)] == ["normal", "em"]
    assert stars.calibration(0).reference.frames == 4
    assert stars.bench.registration.method == "centroids"
    assert not (tmp_path / "refused").exists()
    made = {path.name for path in tmp_path.iterdir() if path.is_file()} - {"paper_experiment.toml"}
    reports = {"square.pdf", "table2.pdf", "zonal.pdf", "affine.pdf", "affine_zonal.pdf"}
    assert made == reports | {"bench.toml", "lattice.png", "square.csv", "psf.tif"}


def test_documented_exposures_match_camera() -> None:
    rows = re.findall(
        r"^\| (em|normal) \| (\d).*? \| ([\d.]+) ms \.\.\. ([\d.]+) s \|(.*?)\|(.*?)\|$", CAMERA, re.MULTILINE
    )
    assert len(rows) == 4
    for amplifier, speed, shortest_ms, longest_s, pinholes, square in rows:
        allowed = exposure_range_s(amplifier, int(speed))
        assert (allowed.minimum, allowed.maximum) == pytest.approx((float(shortest_ms) / 1e3, float(longest_s)))
        for exposure_s, answer in ((3.8, pinholes), (0.15, square)):
            assert ("yes" in answer) == (allowed.minimum <= exposure_s <= allowed.maximum)
    bench = load_bench("paper_experiment")
    camera = bench.camera_model
    assert (camera.amplifier, camera.readout_speed, camera.exposure_s) == ("em", 2, 0.15)


def test_documented_real_bench_loads() -> None:
    (sections,) = re.findall(r"^```toml\n(.*?)^```", OWN_SENSOR, re.MULTILINE | re.DOTALL)
    preset = app.bench.presets.PRESETS["paper_experiment"].read_text("utf-8")
    rest = re.sub(r"^\[(camera|light)\]\n(?:(?!\[).*\n)*", "", preset, flags=re.MULTILINE)
    bench = parse_bench(rest + sections, "the text")
    assert not bench.is_simulated
    assert (bench.camera.driver, bench.light.driver) == ("dcam", "thorlabs_dc4100")


@pytest.mark.slow
def test_prompts_match_documentation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    camera = FakeCamera()
    camera.stage = ManualStage("stars")
    monkeypatch.setattr("sys.stdin", Person(camera, presses=2))
    monkeypatch.setattr("app.acquisition.devices.open_devices", opener(camera))
    source = replace(MANUAL.simulation.source, mask="stars")
    bench = replace(MANUAL, simulation=replace(MANUAL.simulation, source=source))
    measure_bench(bench, tmp_path / "m", frames=1, progress=lambda *_: None, average=4)
    asked = capsys.readouterr().err.splitlines()
    assert len(asked) == 2
    assert all(f"    {line}\n" in OWN_SENSOR for line in asked)


def test_linked_pictures_and_pages_exist() -> None:
    for name in re.findall(r"\]\((\w+\.(?:md|png))\)", TEXT):
        assert (DOCS / name).is_file()
        if name.endswith("png"):
            assert_drawn(DOCS / name)


@pytest.mark.slow
def test_measure_applies_mask_average_and_auto_expose(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "bench.toml").write_text(SMALL)
    words = ("measure", "--bench", tmp_path / "bench.toml", "--frames", "1")
    assert run(monkeypatch, *words, "--out", tmp_path / "a", "--mask", "pinholes") == 2
    assert 'must be one of "square", "stars"' in capsys.readouterr().err
    dim = ("--average", "5", "--auto-expose", "--set", "camera.exposure_s=0.03", "--set", "light.current_a=0.1")
    assert run(monkeypatch, *words, "--out", tmp_path / "b", *dim) == 0
    reference = Recording(tmp_path / "b").calibration(0).reference
    assert reference.frames == 5
    assert 0.65 < reference.mean.max() / 65535 < 0.75  # auto-exposure: 70 % +- 5 % of full scale
    assert Recording(tmp_path / "b").line(0).exposure_s == pytest.approx(reference.exposure_s)
    with xr.open_dataset(tmp_path / "b" / "results.nc") as results:
        in_force = parse_bench(results.attrs["bench"], "results.nc")
    assert in_force.camera_model.exposure_s == pytest.approx(reference.exposure_s)
    hopeless = (
        "--auto-expose",
        "--set",
        "camera.readout_speed=3",
        "--set",
        "light.maximum_current_a=1e-12",
        "--set",
        "light.current_a=0",
    )
    capsys.readouterr()
    assert run(monkeypatch, *words, "--out", tmp_path / "c", *hopeless) == 1
    assert "light" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()  # nothing is recorded without an exposure
    assert run(monkeypatch, "measure", "--help") == 0
    assert f"[default: {FRAMES}]" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_used_folder_is_refused_before_opening_devices(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def opened(*_: object) -> None:
        raise Interrupted("a device was opened")

    monkeypatch.setattr("app.acquisition.worker.Acquisition", opened)
    (tmp_path / "run.json").write_text("{}")
    words = ("measure", "--bench", "paper_experiment", "--frames", "1", "--out", tmp_path)
    assert run(monkeypatch, *words) == 2
    assert "holds a recording already" in capsys.readouterr().err
