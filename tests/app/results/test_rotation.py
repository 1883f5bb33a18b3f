"""The rotation of the subimages in results, on the terminal and in the window's warning."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run
from support.optics import FIELD, SmallBench
from support.paths import DOCS

from app.acquisition.dark_reference_store import AverageState
from app.acquisition.instrument import Status
from app.bench.config import Bench, write_bench
from app.gui.shell.status_text import warning
from app.results.dataset import result_dataset
from app.results.run_summary import ROTATES
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from reconstruction.wavefront import Wavefront

TWIST = 400.0  # rad/m at the field's edge
ROTATION = {"rotation", "rotation_sigma", "rotation_significance", "circulation_chi_square", "contradicts_layers"}


@pytest.fixture(scope="module")
def bench() -> SmallBench:
    return SmallBench(4, 5)


def seen(bench: SmallBench, *, twists: bool) -> np.ndarray:
    """A frame behind a tilt that grows along the field, or that turns every subimage from +x to +y."""
    u, v = bench.samples()
    sign = -1 if twists else 1
    scale = TWIST / FIELD.half_width_m
    return bench.frame(lambda x, y: (scale * (v * x + sign * u * y)).astype(np.float32))


def measured(bench: SmallBench, *, twists: bool, rotation: bool = True) -> Wavefront:
    settings = RegistrationSettings(warp="quadratic", rotation=rotation)
    return bench.reconstructor(registration=settings, pupil_modes=10)(seen(bench, twists=twists))


def test_results_hold_the_rotation_only_if_it_is_allowed(bench: SmallBench) -> None:
    dataset = result_dataset(measured(bench, twists=True))
    expected = TWIST / bench.sensor.slope_per_px / FIELD.half_width_px(bench.sensor)
    np.testing.assert_allclose(dataset["rotation"], expected, rtol=0.1)
    assert dataset["rotation"].attrs["units"] == "rad"
    assert float(dataset["rotation_significance"]) > 5
    assert bool(dataset["contradicts_layers"])
    text = (DOCS / "results.md").read_text("utf-8")
    assert all(f"`{name}`" in text for name in ROTATION)
    sheared = result_dataset(measured(bench, twists=False))
    assert set(dataset) == set(sheared)
    assert not bool(sheared["contradicts_layers"])
    assert set(dataset) - set(result_dataset(measured(bench, twists=True, rotation=False))) == ROTATION


@pytest.mark.parametrize(("twists", "rotation"), [(True, True), (False, True), (True, False)])
def test_reconstruct_prints_the_rotation_and_its_warning(
    bench: SmallBench,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    *,
    twists: bool,
    rotation: bool,
) -> None:
    settings = Bench(
        sensor=bench.sensor,
        field=FIELD,
        lattice=bench.lattice,
        registration=RegistrationSettings(warp="affine", rotation=rotation),
        reconstruction=ReconstructionSettings(pupil_modes=10),
    )
    (tmp_path / "bench.toml").write_text(write_bench(settings))
    frame, scale = seen(bench, twists=twists), 3e4 / bench.reference.max()
    tifffile.imwrite(tmp_path / "frame.tif", (frame * scale).astype(np.uint16))
    tifffile.imwrite(tmp_path / "reference.tif", (bench.reference * scale).astype(np.uint16))
    files = ("--reference", tmp_path / "reference.tif", "--bench", tmp_path / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *files) == 0
    printed = capsys.readouterr().out
    assert ("rotation of the subimages: +" in printed) is rotation
    assert ("times its error" in printed) is rotation
    assert (f"warning: {ROTATES}" in printed) is (twists and rotation)
    with xr.open_dataset(tmp_path / "r.nc") as result:
        assert ("rotation" in result) is rotation


@pytest.mark.slow
@pytest.mark.long
def test_measure_prints_the_rotation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    common = ("measure", "--bench", small_toml, "--frames", "2", "--average", "4", "--set", "registration.warp=affine")
    assert run(monkeypatch, *common, "--out", tmp_path / "a", "--set", "registration.rotation=true") == 0
    printed = capsys.readouterr().out
    assert "times its error" in printed
    assert ROTATES not in printed
    assert run(monkeypatch, *common, "--out", tmp_path / "b") == 0
    assert "rotation of" not in capsys.readouterr().out


class Good:
    """The part of a status that the warning depends on, when all is well."""

    warning, is_light_on = "", True
    dark = reference = AverageState("20 frames")
    area, capabilities = SimpleNamespace(region=None), SimpleNamespace(sensor=None)
    bench = SimpleNamespace(registration=SimpleNamespace(rotation=True))


class NoDark(Good):
    warning, dark = "no dark", AverageState()


def test_window_warns_last_that_subimages_rotate(bench: SmallBench) -> None:
    good, no_dark = cast("Status", Good()), cast("Status", NoDark())
    twisted, sheared = measured(bench, twists=True), measured(bench, twists=False)
    assert warning(good, "", twisted) == ROTATES
    assert warning(good, "", sheared) == ""
    assert warning(good, "", measured(bench, twists=True, rotation=False)) == ""
    assert warning(good, "too dark", twisted) == "too dark"
    assert warning(no_dark, "", twisted).startswith("no dark")
