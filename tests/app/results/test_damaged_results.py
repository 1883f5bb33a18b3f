"""Damaged files of results: one sentence for every command that reads them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from support.command_line import run
from support.optics import SmallBench
from support.paths import FOREIGN_FRAMES

from app.bench.config import load_bench
from app.errors import InputError
from app.results.dataset import result_dataset, stack_frames
from app.results.result_file import open_results, write_pieces, write_results
from app.results.shown_wavefront import StoredWavefront
from app.results.sources import mean_wavefront, read_bench_of, stored_frame

BENCH = load_bench(
    FOREIGN_FRAMES / "bench.toml",
    ("sensor.lenslet_rows=7", "sensor.lenslet_columns=9", "registration.warp=affine", "reconstruction.pupil_modes=21"),
)


@pytest.fixture(scope="module")
def dataset(small_bench: SmallBench) -> xr.Dataset:
    return result_dataset(small_bench.reconstructor()(small_bench.reference))


@pytest.fixture(scope="module")
def whole(dataset: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "whole.nc"
    write_results(path, dataset, bench=BENCH, inputs={})
    read_all(path)  # a file that is not damaged
    return path


@pytest.fixture
def mine(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(whole, tmp_path / "r.nc"))


def _loop(file: h5py.File) -> None:
    del file["rms"]
    file["rms"] = h5py.SoftLink("/rms")


def _external(file: h5py.File) -> None:
    del file["view_row"]
    file["view_row"] = h5py.ExternalLink("/nowhere.nc", "/view_row")


def _no_dimensions(file: h5py.File) -> None:
    del file["coefficients"].attrs["DIMENSION_LIST"]


def _no_scale(file: h5py.File) -> None:
    del file["pupil_mode"]


def _wrong_encoding(file: h5py.File) -> None:
    file["wavefront"].attrs["scale_factor"] = "x"


def _numbers_for_dimensions(file: h5py.File) -> None:
    file["view_y"].attrs["DIMENSION_LIST"] = np.arange(4)


def _too_many_dimensions(file: h5py.File) -> None:
    links = np.empty(4, object)
    links[:] = [np.array([file["view_row"].ref], h5py.ref_dtype)] * 4
    file["view_y"].attrs.create("DIMENSION_LIST", links, dtype=h5py.vlen_dtype(h5py.ref_dtype))


def _numbers_for_users_of_a_dimension(file: h5py.File) -> None:
    file["view_row"].attrs["REFERENCE_LIST"] = np.arange(4)


_BROKEN = [_loop, _external, _no_dimensions, _no_scale, _wrong_encoding]
_ODD_LINKS = [_numbers_for_dimensions, _too_many_dimensions, _numbers_for_users_of_a_dimension]


def read_all(path: Path) -> None:
    """Read a file in all the ways of the commands."""
    stored_frame(path, 0, "displacement", "displacement_sigma", "valid")
    mean_wavefront(path, read_bench_of(path), None, lambda *_: None)
    StoredWavefront.from_results(path)


@pytest.mark.parametrize("damage", [*_BROKEN, *_ODD_LINKS])
def test_broken_structure_is_one_sentence(damage: Callable[[h5py.File], None], mine: Path) -> None:
    with h5py.File(mine, "r+") as file:
        damage(file)
    with pytest.raises(InputError, match=r"r\.nc: .*damaged"):
        read_all(mine)


def test_flipped_bytes_are_sentences(mine: Path) -> None:
    """Also without checksums, as in files before 0.3."""
    with h5py.File(mine, "r+") as file:
        del file["crc32"]
    content, rng, refused = mine.read_bytes(), np.random.default_rng(3), 0
    for _ in range(40):
        damaged = bytearray(content)
        for place in rng.integers(0, len(content) // 3, 8):
            damaged[place] ^= 1 << rng.integers(8)
        mine.write_bytes(damaged)
        try:
            read_all(mine)
        except InputError:
            refused += 1
    assert refused > 10


def test_command_says_it_in_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], mine: Path, tmp_path: Path
) -> None:
    with h5py.File(mine, "r+") as file:
        _loop(file)
    for words in (("layers",), ("field",), ("corrector",)):
        assert run(monkeypatch, *words, mine, "--out", tmp_path / "out.nc") == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert "r.nc: cannot be opened as results" in line


@pytest.mark.parametrize("name", ["wavefront", "displacement", "view_x", "xy", "slope_chi_square"])
def test_changed_variable_is_found(name: str, mine: Path) -> None:
    with h5py.File(mine, "r+") as file:
        values = file[name][...]
        file[name][...] = values[::-1] if values.ndim == 1 else values + 1e-9
    with pytest.raises(InputError, match=f"is damaged: {name} is not what was written"):
        open_results(mine)


def test_changed_bench_is_found(mine: Path) -> None:
    with h5py.File(mine, "r+") as file:
        file.attrs["bench"] = file.attrs["bench"].replace("462e-09", "463e-09").replace("4.62e-07", "4.63e-07")
    with pytest.raises(InputError, match=r"r\.nc: is damaged: its bench is not what was written"):
        open_results(mine)
    with h5py.File(mine, "r+") as file:
        del file["crc32"].attrs["bench attribute"]  # as files of earlier versions
    open_results(mine).close()


@pytest.mark.slow
@pytest.mark.long
def test_checksums_of_many_pieces_hold(dataset: xr.Dataset, tmp_path: Path) -> None:
    pieces = [stack_frames([dataset] * count, range(count), [0.0] * count, [0.0] * count) for count in (32, 32, 9)]
    write_pieces(tmp_path / "r.nc", pieces, bench=BENCH, inputs={})
    with open_results(tmp_path / "r.nc") as read:
        assert read.sizes["frame"] == 73
        assert "crc32" not in read
        read.isel(frame=[3]).to_netcdf(tmp_path / "mine.nc", engine="h5netcdf")
    with h5py.File(tmp_path / "r.nc") as file:
        assert set(file["crc32"].attrs) == {*map(str, pieces[0].variables), "bench attribute"}
    with open_results(tmp_path / "mine.nc") as mine:  # changed by its owner
        assert mine.sizes["frame"] == 1


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e300])
def test_impossible_displacements_are_said(wrong: float, dataset: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "r.nc"
    changed = dataset.copy(deep=True)
    changed["displacement"][2, 2] = wrong
    write_results(path, changed, bench=BENCH, inputs={})
    with pytest.raises(InputError, match="a valid lenslet has a displacement that none can have"):
        read_all(path)


def test_results_without_a_valid_lenslet_are_refused(dataset: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "r.nc"
    write_results(path, dataset.assign(valid=dataset["valid"] & False), bench=BENCH, inputs={})
    with pytest.raises(InputError, match="a frame without a valid lenslet"):
        read_all(path)
