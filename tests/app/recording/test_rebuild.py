"""Recovery of metadata, damaged calibrations, and what is on the disk before a frame counts."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from support.command_line import run
from support.optics import SmallBench
from support.recordings import record
from support.records import FACTS, make_record, noisy_calibration, write

from app.errors import InputError, RunError
from app.recording.calibration_files import read_calibration, write_calibration
from app.recording.folder import check_free
from app.recording.reader import Recording
from app.recording.recover import recover
from app.recording.writer import RecordingWriter

ARRAYS = ("frames.zarr/0", "frames.zarr/results/0/displacement", "frames.zarr/results/0/coefficients")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, quick_toml: Path) -> Recording:
    return record(quick_toml, tmp_path_factory.mktemp("recorded") / "run", frames=4)


@pytest.fixture
def recording(recorded: Recording, tmp_path: Path) -> Recording:
    """A copy that may be damaged."""
    return Recording(shutil.copytree(recorded.folder, tmp_path / "run"))


def metadata_of(folder: Path) -> dict[str, Any]:
    files = folder.joinpath("frames.zarr").rglob("zarr.json")
    return {path.relative_to(folder).as_posix(): json.loads(path.read_text()) for path in files}


@pytest.mark.parametrize("damage", ["missing", "empty", "half", "other", "type"])
@pytest.mark.parametrize("is_complete", [True, False])
def test_missing_metadata_are_made_again(recording: Recording, damage: str, is_complete: bool) -> None:
    before = metadata_of(recording.folder)
    for name in (*ARRAYS, "frames.zarr") if damage == "missing" else ARRAYS:
        path = recording.folder / name / "zarr.json"
        text = path.read_bytes()
        types = text.replace(b'"uint16"', b'"int16"').replace(b'"float64"', b'"int64"')
        damaged = {"half": text[:90], "other": b"[]", "type": types}.get(damage, b"")
        path.unlink() if damage == "missing" else path.write_bytes(damaged)
    if not is_complete:
        path = recording.folder / "run.json"
        path.write_text(json.dumps({**recording.run, "complete": False}))
    found = recover(recording.folder)
    assert (found.whole, found.damage, len(found.rebuilt)) == ([0, 1, 2, 3], (), 3 + (damage == "missing"))
    assert metadata_of(recording.folder) == before
    read = zarr.open_array(recording.folder / ARRAYS[0], mode="r")
    for index in range(4):
        np.testing.assert_array_equal(read[index], recording.pixels(index))
    assert recover(recording.folder).rebuilt == ()


def test_metadata_that_no_calibration_explains_are_reported(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(3)])
    (tmp_path / "r" / ARRAYS[0] / "zarr.json").unlink()
    found = recover(tmp_path / "r")
    assert "zarr.json is missing or damaged and cannot be made again" in found.rebuilt[0]
    assert not found.whole
    (tmp_path / "r" / ARRAYS[0] / "zarr.json").write_text("{")
    with pytest.raises(InputError, match="is missing or damaged and cannot be made again"):
        recover(tmp_path / "r")


@pytest.mark.parametrize(("array", "chunk"), [*((ARRAYS[0], f"c/{frame}/0/0") for frame in (0, 3)), (ARRAYS[1], "")])
def test_shape_follows_from_whole_chunks(recording: Recording, array: str, chunk: str) -> None:
    """The first or the last one may be cut short."""
    before = metadata_of(recording.folder)
    (recording.folder / array / "zarr.json").unlink()
    cut = recording.folder / array / chunk if chunk else max(recording.folder.joinpath(array).glob("c.*"))
    cut.write_bytes(cut.read_bytes()[:-16])
    found = recover(recording.folder)
    assert metadata_of(recording.folder) == before
    assert len(found.damage) == 1
    assert len(found.whole) == (3 if chunk else 4)


@pytest.mark.parametrize("damage", [None, b"", b"\x89HDF\r\n\x1a\n", b'{"format": '])
def test_missing_or_damaged_run_is_made_again(recording: Recording, damage: bytes | None) -> None:
    path = recording.folder / "run.json"
    path.unlink() if damage is None else path.write_bytes(damage)
    found = recover(recording.folder)
    assert (found.whole, found.damage) == ([0, 1, 2, 3], ())
    assert "run.json was missing or damaged and is made again" in found.rebuilt[0]
    kept = recording.folder / "run.damaged.json"
    assert kept.exists() == (kept.name in found.rebuilt[0]) == bool(damage)
    assert not damage or kept.read_bytes() == damage
    again = Recording(recording.folder)
    assert again.is_complete
    assert again.bench.sensor == recording.calibration(0).bench.sensor


def test_recovery_without_whole_frames_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], recording: Recording
) -> None:
    assert run(monkeypatch, "recover", recording.folder) == 0
    shutil.rmtree(recording.folder / "frames.zarr")
    assert run(monkeypatch, "recover", recording.folder) == 1
    assert capsys.readouterr().err == f"svwfs: {recording.folder}: no frame is whole\n"


def test_recovery_without_any_calibration_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], recording: Recording
) -> None:
    (recording.folder / "calibrations/0/reference.npz").write_bytes(b"")
    assert run(monkeypatch, "recover", recording.folder) == 1
    said = capsys.readouterr()
    assert said.err.endswith("no frame can be reconstructed, because no calibration can be read\n")
    assert "reference.npz" in said.out


@pytest.mark.parametrize("command", ["replay {}", "export {} --to csv --out {}.csv", "field {} --out {}.csv"])
def test_frames_without_a_line_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], recording: Recording, command: str
) -> None:
    arguments = command.format(recording.folder, recording.folder).split()
    assert run(monkeypatch, *arguments, "--overwrite") == 0
    assert "have no line" not in capsys.readouterr().out
    path = recording.folder / "frames.jsonl"
    path.write_bytes(path.read_bytes()[:-30])
    assert run(monkeypatch, *arguments, "--overwrite") == 0
    assert "1 of 4 frames have no line; svwfs recover lists them" in " ".join(capsys.readouterr().out.split())


@pytest.mark.timeout(60)
@pytest.mark.parametrize("is_complete", [True, False])
def test_impossible_numbers_of_frames_are_not_counted_to(recording: Recording, is_complete: bool) -> None:
    index, counts = 10**7, {"recorded": 10**9}
    (recording.folder / "run.json").write_text(
        json.dumps({**recording.run, "complete": is_complete, "frames": counts if is_complete else {}})
    )
    pixels = recording.folder / ARRAYS[0] / "c"
    shutil.copytree(pixels / "0", pixels / str(index))
    lines = recording.folder / "frames.jsonl"
    stray = {**json.loads(lines.read_text().splitlines()[0]), "index": index}
    lines.write_text(lines.read_text() + json.dumps(stray) + "\n")
    assert recover(recording.folder).whole == [0, 1, 2, 3]


@pytest.mark.timeout(60)
def test_pipes_are_not_waited_for(recording: Recording) -> None:
    for name in ("frames.zarr/0/c/1/0/0", "calibrations/0/reference.npz", "run.json"):
        path = recording.folder / name
        path.unlink()
        os.mkfifo(path)
    with pytest.raises(InputError, match="is damaged: 0 bytes"):
        recording.pixels(1)
    with pytest.raises(InputError, match=r"reference\.npz: not a file"):
        recording.calibration(0)
    with pytest.raises(InputError, match=r"run\.json: not a file"):
        Recording(recording.folder)


def _save(path: Path, **changes: Any) -> None:
    with np.load(path) as stored:
        np.savez(path, **{**stored, **changes})


def _compress(path: Path) -> None:
    with np.load(path) as stored:
        np.savez_compressed(path, **stored)


def _encrypt(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = data.find(mark)
        while place >= 0:
            data[place + offset] |= 1
            place = data.find(mark, place + 4)
    path.write_bytes(data)


_DAMAGE: dict[str, Callable[[Path], object]] = {
    "compressed": _compress,
    "encrypted": _encrypt,
    "mean is not finite": lambda path: _save(path, mean=np.full((172, 240), np.nan, np.float32)),
    "mean is no image": lambda path: _save(path, mean=np.zeros(7, np.float32)),
    "variance has another size": lambda path: _save(path, variance=np.zeros((3, 3), np.float32)),
    "variance is negative": lambda path: _save(path, variance=np.full((172, 240), -1, np.float32)),
    "frames = 0": lambda path: _save(path, frames=0),
    "frames = 'a'": lambda path: _save(path, frames="a"),
    "em_gain = 0": lambda path: _save(path, em_gain=0.0),
    "exposure_s = nan": lambda path: _save(path, exposure_s=np.nan),
    "not a zip file": lambda path: path.write_bytes(b"no archive"),
    "variance is not a file in the archive": lambda path: np.savez(path, mean=np.zeros((172, 240))),
}


@pytest.mark.parametrize("sentence", _DAMAGE)
def test_damaged_calibration_is_refused_in_one_line(recording: Recording, sentence: str) -> None:
    path = recording.folder / "calibrations/0/reference.npz"
    _DAMAGE[sentence](path)
    with pytest.raises(InputError) as fault:
        read_calibration(path.parent)
    assert str(fault.value).startswith(f"{path}: cannot be read: ")
    assert sentence in str(fault.value)
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("full_scale", ["NaN", "-1", "1e308", "Infinity", "null", "[]", '"x"', "1" * 400])
def test_impossible_full_scale_is_refused(recording: Recording, full_scale: str) -> None:
    path = recording.folder / "calibrations/0/camera.json"
    path.write_text(f'{{"full_scale": {full_scale}}}')
    with pytest.raises(InputError, match=r"camera\.json: cannot be read"):
        read_calibration(path.parent)


def test_missing_calibration_is_named(recording: Recording) -> None:
    shutil.rmtree(recording.folder / "calibrations/0")
    with pytest.raises(InputError, match=r"calibrations/0/bench\.toml: no such file$"):
        recording.calibration(0)


def test_everything_a_frame_needs_is_on_disk_before_its_line(
    tmp_path: Path, small_bench: SmallBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without fsync, a power failure could leave an empty reference, and every frame would be useless."""
    folder, synced = tmp_path / "r", set()

    def note(file: int) -> None:
        if not (folder / "frames.jsonl").exists() or not (folder / "frames.jsonl").stat().st_size:
            synced.add(os.fstat(file).st_ino)

    monkeypatch.setattr(os, "fsync", note)
    calibration = noisy_calibration(small_bench)
    with closing(RecordingWriter(folder, FACTS)) as writer:
        writer.write(make_record(0, calibration, start=np.zeros((7, 9, 3, 2)), bias=np.zeros((7, 9, 3, 2))))
    metadata = [*folder.rglob("zarr.json")]
    files = [*folder.glob("*.*"), *folder.rglob("*.npy"), *folder.joinpath("calibrations").rglob("*")]
    files += [*metadata, *(path.parent for path in metadata), tmp_path, folder / "calibrations"]
    lost = [path for path in files if path.stat().st_ino not in synced and path.name != "frames.jsonl"]
    assert not lost
    assert len(files) >= 15


def test_files_are_on_disk_before_the_folders_that_name_them(
    tmp_path: Path, small_bench: SmallBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name that survives a power failure must lead to its contents."""
    folder, synced, named = tmp_path / "r", [], {}

    def note(file: int) -> None:
        path = Path(f"/proc/self/fd/{file}").resolve()
        synced.append(path)
        if path.is_dir():
            named[path] = {each.name for each in path.iterdir()}

    monkeypatch.setattr(os, "fsync", note)
    with closing(RecordingWriter(folder, FACTS)) as writer:
        writer.write(make_record(0, noisy_calibration(small_bench)))
    last = {path: number for number, path in enumerate(synced)}
    for metadata in folder.rglob("zarr.json"):
        assert synced.index(metadata) < last[metadata.parent]
        assert "zarr.json" in named[metadata.parent]
    store = folder / "frames.zarr"
    assert [named[path] >= {name} for path, name in ((folder / "calibrations", "0"), (store, "0"))] == [True, True]
    assert last[folder / "calibrations"] < last[folder]
    assert "calibrations" in named[folder]


def test_folder_left_by_a_program_that_died_at_once_is_free(tmp_path: Path) -> None:
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "frames.jsonl").touch()
    check_free(tmp_path / "r")
    write(tmp_path / "r", [make_record(0)])
    assert len(Recording(tmp_path / "r")) == 1
    with pytest.raises(InputError, match="holds a recording already"):
        RecordingWriter(tmp_path / "r", FACTS)


def test_no_recording_begins_inside_another(recording: Recording, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(recording.folder)
    for folder in (recording.folder / "sub", tmp_path / "link" / "calibrations" / "sub"):
        with pytest.raises(InputError, match=f"lies in the recording {recording.folder}: choose another folder"):
            check_free(folder)
    check_free(tmp_path / "sub")


@pytest.mark.parametrize(
    ("versions", "who"),
    [({"svwfs": "99.1"}, "a newer svwfs, 99.1, wrote it"), (None, "svwfs, of unknown version, wrote")],
)
def test_run_of_a_later_format_names_its_version_and_stays(recording: Recording, versions: object, who: str) -> None:
    path = recording.folder / "run.json"
    path.write_text(json.dumps({**recording.run, "format": "svwfs recording 2", "versions": versions}))
    before = path.read_bytes()
    with pytest.raises(InputError, match=rf"run\.json: .*{who}.*: update svwfs to read it$"):
        recover(recording.folder)
    assert path.read_bytes() == before
    path.write_text(json.dumps({**recording.run, "format": "another program's 2"}))
    with pytest.raises(InputError, match=r"run\.json: not the file of a recording"):
        recover(recording.folder)


@pytest.mark.parametrize("version", ["99.1", "0.2.0"])
def test_bench_with_settings_of_a_newer_version_names_it(recording: Recording, version: str) -> None:
    path, bench = recording.folder / "run.json", f"{recording.run['bench']}\n[future]\nx = 1\n"
    path.write_text(json.dumps({**recording.run, "bench": bench, "versions": {"svwfs": version}}))
    (recording.folder / "calibrations/0/bench.toml").write_text(bench)
    said = (
        "a newer svwfs, 99.1, wrote it: update svwfs to read it$" if version == "99.1" else "future is an unknown key"
    )
    newer = Recording(recording.folder)
    with pytest.raises(InputError, match=said):
        _ = newer.bench
    with pytest.raises(InputError, match=said):
        newer.calibration(0)


def test_renamed_folder_leaves_no_ghost(tmp_path: Path) -> None:
    with closing(RecordingWriter(tmp_path / "r", FACTS)) as writer:
        writer.write(make_record(0))
        (tmp_path / "r").rename(tmp_path / "moved")
        with pytest.raises(RunError, match=r"frames\.jsonl: was removed or renamed during the recording"):
            writer.finish("", acquired=1, facts={})
    assert not (tmp_path / "r").exists()
    assert recover(tmp_path / "moved").whole == [0]


def test_calibration_is_written_whole_or_not_at_all(
    tmp_path: Path, small_bench: SmallBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_up(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", fill_up)
    with pytest.raises(RunError, match=r"reference\.npz: cannot be written: No space left on device"):
        write_calibration(tmp_path / "0", noisy_calibration(small_bench))
    assert not list(tmp_path.iterdir())
