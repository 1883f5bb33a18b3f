"""What a program that died, or a power cut, leaves of a recording: it is finished, and nothing is thrown away."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import zarr
from optics import SmallBench
from records import SHAPE, make_chain, noisy_calibration, write

from app.calibration import Calibration
from app.errors import InputError
from app.recording.reader import Recording
from app.recording.recover import recover


@pytest.fixture(scope="module")
def calibration(small_bench: SmallBench) -> Calibration:
    return noisy_calibration(small_bench)


def test_recovering_twice_and_a_half_line(tmp_path: Path, calibration: Calibration) -> None:
    records = make_chain(calibration, 5)
    write(tmp_path / "r", [replace(records[0], lost=4), *records[1:]], finish=False)
    path = tmp_path / "r" / "frames.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines()[-1][:40])
    assert len(Recording(tmp_path / "r")) == 5
    found = recover(tmp_path / "r")
    assert (found.was_complete, found.frames, found.reconstructed) == (False, 5, 5)
    assert (found.lost, found.gaps, found.left_out) == (4, 1, "")
    assert path.read_bytes() == whole
    assert zarr.open_array(tmp_path / "r" / "frames.zarr" / "0", mode="r").shape == (5, *SHAPE)
    assert zarr.open_array(tmp_path / "r/frames.zarr/results/0/displacement", mode="r").shape[0] == 5
    everything = {path: path.read_bytes() for path in (tmp_path / "r").rglob("*") if path.is_file()}
    assert recover(tmp_path / "r") == replace(found, was_complete=True)
    assert {path: path.read_bytes() for path in (tmp_path / "r").rglob("*") if path.is_file()} == everything
    assert "recovered" in Recording(tmp_path / "r").ended_early


def test_a_recording_that_had_just_begun_is_recovered(tmp_path: Path) -> None:
    write(tmp_path / "r", [], finish=False)
    (tmp_path / "r" / "frames.jsonl").unlink()
    assert recover(tmp_path / "r").frames == 0
    assert len(Recording(tmp_path / "r")) == 0


def _cut_short(folder: Path) -> None:
    chunk = folder / "frames.zarr" / "0" / "c" / "3" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:50])


def _spoil(folder: Path) -> None:
    lines = (folder / "frames.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "frames.jsonl").write_bytes(b"".join([*lines[:3], b"\0" * 20 + b"\n", *lines[4:]]))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_cut_short, "frame 3 are not whole"),
        (lambda folder: (folder / "frames.zarr/0/c/3/0/0").unlink(), "frame 3 are not whole"),
        (_spoil, "line 4 is damaged"),
    ],
)
def test_after_a_power_cut_what_is_whole_is_kept_and_nothing_thrown_away(
    tmp_path: Path, calibration: Calibration, damage: Callable[[Path], None], said: str
) -> None:
    write(tmp_path / "r", make_chain(calibration, 6), finish=False)
    damage(tmp_path / "r")
    text = (tmp_path / "r" / "frames.jsonl").read_bytes()
    with pytest.raises(InputError):
        Recording(tmp_path / "r").frame(3)
    found = recover(tmp_path / "r")
    assert found.frames == 3
    assert said in found.left_out
    kept = (tmp_path / "r" / "frames.jsonl").read_bytes()
    assert kept + (tmp_path / "r" / "frames.damaged.jsonl").read_bytes() == text
    assert kept.count(b"\n") == 3
    assert (tmp_path / "r/frames.zarr/0/c/5/0/0").exists()
