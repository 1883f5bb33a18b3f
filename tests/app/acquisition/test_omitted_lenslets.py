"""A bench that omits rows and columns of lenslets: the reference shows them, live and in files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run
from support.gui_bench import BENCH, FakeCamera, opener
from support.spot_frames import hexagonal_centers_px, spots

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument
from app.bench.config import load_bench, parse_bench, write_bench
from app.commands.calibrate import bench_text
from app.errors import InputError
from app.gui.shell.status_text import area_taken
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import survey

OMITTED = replace(BENCH, sensor=replace(BENCH.sensor, lenslet_rows=None, lenslet_columns=None), lattice=None)
HEXAGONAL = """# mine
[sensor]
lenslet_pitch_m = 480e-6 # by the maker
lenslet_focal_length_m = 46.7e-3
wavelength_m = 462e-9
pixel_pitch_m = 16e-6

[lattice]
arrangement = "hexagonal"

[field]
collimator_focal_length_m = 0.2
half_width_m = 1e-4
view_rows = 1
view_columns = 1

[registration]
method = "centroids"
star_rows = 1
star_columns = 1

[reconstruction]
pupil_modes = 10
"""


@pytest.fixture
def instrument() -> Iterator[Instrument]:
    camera = FakeCamera()
    with opener(camera)(OMITTED, lambda _: None) as devices, closing(Instrument(devices, OMITTED)) as made:
        camera.start()
        yield made


def test_instrument_finds_lenslets_in_the_reference(instrument: Instrument) -> None:
    before = instrument.status()
    assert before.lattice is None
    assert area_taken(before, before.area)[1]  # says nothing of lenslets
    instrument.take_dark(2)
    instrument.set_light_on(True)
    instrument.take_reference(2)
    after = instrument.status()
    assert after.warning == ""
    assert after.bench.sensor.lenslets == BENCH.sensor.lenslets
    assert after.lattice is not None
    assert parse_bench(write_bench(after.bench_in_force), "b") == after.bench_in_force
    measured = instrument.measure(instrument.devices.camera.read(1.0))
    assert measured.wavefront is not None
    assert measured.wavefront.displacement.valid.all()
    found = instrument.survey_lattice()
    instrument.change_settings([("sensor", found.sensor), ("lattice", found.lattice)])  # as the window does
    assert instrument.bench.lattice == found.lattice


def test_lattice_needs_the_numbers_of_lenslets() -> None:
    with pytest.raises(InputError, match=r"sensor\.lenslet_rows is missing: \[lattice\] gives the middle of all rows"):
        parse_bench(HEXAGONAL, "b", ("lattice.center_x_px=255", "lattice.center_y_px=255", "lattice.pitch_px=30"))


def test_simulated_devices_need_the_numbers_of_lenslets() -> None:
    with pytest.raises(InputError, match=r"sensor\.lenslet_rows and lenslet_columns are omitted.*set them"):
        open_devices(parse_bench(HEXAGONAL, "b"), lambda _: None)


def test_calibrate_writes_them_and_keeps_comments() -> None:
    bench = parse_bench(HEXAGONAL, "b")
    found = survey(spots(hexagonal_centers_px(angle_deg=30)), bench.sensor)
    calibrated = replace(bench, sensor=found.sensor, lattice=found.lattice)
    text = bench_text(HEXAGONAL, calibrated)
    assert "# mine" in text
    assert "# by the maker" in text
    assert parse_bench(text, "b") == calibrated


def test_stretch_of_the_lattice_returns_from_its_text() -> None:
    lattice = Lattice(center_x_px=200.0, center_y_px=150.0, pitch_px=31.0, stretch=(0.02, -0.01))
    bench = replace(BENCH, lattice=lattice)
    assert parse_bench(write_bench(bench), "b") == bench
    with pytest.raises(InputError, match=r"lattice\.stretch must be -0\.1 \.\.\. 0\.1"):
        parse_bench(write_bench(bench), "b", ("lattice.stretch=[0.3, 0]",))


def test_command_reconstructs_a_turned_hexagonal_array(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    centers_px = hexagonal_centers_px(angle_deg=30)
    tifffile.imwrite(tmp_path / "reference.tif", spots(centers_px))
    tifffile.imwrite(tmp_path / "frame.tif", spots(centers_px + np.array([0.6, -0.4]), seed=1))
    (tmp_path / "bench.toml").write_text(HEXAGONAL, "utf-8")
    out, plot = tmp_path / "r.nc", tmp_path / "p.png"
    images = (tmp_path / "frame.tif", "--reference", tmp_path / "reference.tif", "--bench", tmp_path / "bench.toml")
    assert run(monkeypatch, "reconstruct", *images, "--out", out, "--plot", plot) == 0
    assert "163 of 163 lenslets valid" in capsys.readouterr().out
    with xr.open_dataset(out) as results:
        assert results.valid.sum() == 163
        shown = results.wavefront.values[0, 0]
        np.testing.assert_array_equal(np.isfinite(shown), results.valid.values.astype(bool))
        saved = parse_bench(results.attrs["bench"], "r")
    assert saved.sensor.lenslets == results.valid.shape
    assert plot.stat().st_size > 0
    assert load_bench(tmp_path / "bench.toml").sensor.lenslet_rows is None
