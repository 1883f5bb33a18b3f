"""Damaged files of results: one sentence for every command that reads them."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from typing import Any

import h5netcdf
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


def read_all(path: Path) -> None:
    """Read a file in all the ways of the commands."""
    stored_frame(path, 0, "displacement", "displacement_sigma", "valid")
    mean_wavefront(path, read_bench_of(path), None, lambda *_: None)
    StoredWavefront.from_results(path)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.999])
def test_truncated_file_is_one_sentence(share: float, mine: Path) -> None:
    mine.write_bytes(mine.read_bytes()[: int(share * mine.stat().st_size)])
    with pytest.raises(InputError, match=r"r\.nc: .*damaged"):
        read_all(mine)


def test_each_flipped_bit_is_found(mine: Path) -> None:
    content, rng = mine.read_bytes(), np.random.default_rng(3)
    for place in rng.integers(0, len(content) - 30, 40):
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.integers(8)
        mine.write_bytes(damaged)
        with pytest.raises(InputError, match=r"r\.nc: is damaged: it is not what was written; reconstruct"):
            read_all(mine)


def test_command_says_it_in_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], mine: Path, tmp_path: Path
) -> None:
    mine.write_bytes(mine.read_bytes()[:-1000])
    for words in (("layers",), ("field",), ("corrector",)):
        assert run(monkeypatch, *words, mine, "--out", tmp_path / "out.nc") == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert "r.nc: cannot be opened as results" in line


@pytest.mark.slow
@pytest.mark.long
def test_file_of_many_pieces_is_whole(dataset: xr.Dataset, tmp_path: Path) -> None:
    pieces = [stack_frames([dataset] * count, range(count), [0.0] * count, [0.0] * count) for count in (32, 32, 9)]
    write_pieces(tmp_path / "r.nc", pieces, bench=BENCH, inputs={})
    with open_results(tmp_path / "r.nc") as read:
        assert read.sizes["frame"] == 73
        xr.testing.assert_equal(read.isel(frame=72).drop_vars("pupil_mode_name"), pieces[0].isel(frame=8))
        read.isel(frame=[3]).to_netcdf(tmp_path / "mine.nc", engine="h5netcdf")
    with open_results(tmp_path / "mine.nc") as mine:  # changed by its owner
        assert mine.sizes["frame"] == 1


def test_file_that_another_program_has_changed_opens(mine: Path) -> None:
    """Files without a checksum, also those of earlier versions."""
    with h5py.File(mine, "r+") as file:
        file.attrs["note"] = "mine"
        file.create_group("crc32").attrs["wavefront"] = np.uint32(7)
    with open_results(mine) as read:
        assert read.attrs["note"] == "mine"


def test_error_bar_below_0_is_refused(mine: Path) -> None:
    with h5py.File(mine, "r+") as file:  # which has no checksum then
        file["coefficients_sigma"][2, 1] *= -1
        file.attrs["note"] = "mine"
    with pytest.raises(InputError, match="an error bar below 0"):
        stored_frame(mine, 0)


def test_share_without_file_locks_keeps_results(
    monkeypatch: pytest.MonkeyPatch, dataset: xr.Dataset, mine: Path, tmp_path: Path
) -> None:
    """HDF5 fails there (ENOLCK) unless it is to do without locks."""

    class OnShare(h5netcdf.File):  # type: ignore[misc] # without types
        def __new__(cls, path: Any, *_: Any, locking: bool = True, **__: Any) -> Any:
            if locking and isinstance(path, str | Path):  # and not in memory
                raise OSError(errno.ENOLCK, "unable to lock file: No locks available")
            return super().__new__(cls)

    monkeypatch.setattr(h5netcdf, "File", OnShare)
    read_all(mine)
    pieces = [stack_frames([dataset] * 2, range(2), [0.0] * 2, [0.0] * 2) for _ in range(2)]
    write_pieces(tmp_path / "pieces.nc", pieces, bench=BENCH, inputs={})
    with open_results(tmp_path / "pieces.nc") as read:
        assert read.sizes["frame"] == 4


def test_file_that_another_program_holds_is_not_damaged(mine: Path) -> None:
    fcntl = pytest.importorskip("fcntl", reason="Windows locks in another way")
    with mine.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        read_all(mine)
