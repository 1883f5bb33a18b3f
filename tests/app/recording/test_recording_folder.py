"""Folders of recordings: where one may begin, other versions, what is on the disk before a frame counts."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.optics import SmallBench
from support.recordings import record
from support.records import FACTS, make_record, noisy_calibration, write

from app.errors import InputError, RunError
from app.recording.calibration_files import write_calibration
from app.recording.folder import check_free
from app.recording.reader import Recording
from app.recording.recover import recover
from app.recording.writer import RecordingWriter


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, quick_toml: Path) -> Recording:
    return record(quick_toml, tmp_path_factory.mktemp("recorded") / "run", frames=4)


@pytest.fixture
def recording(recorded: Recording, tmp_path: Path) -> Recording:
    """A copy that may be damaged."""
    return Recording(shutil.copytree(recorded.folder, tmp_path / "run"))


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


@pytest.mark.posix  # Windows forces no folder to the disk
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
        writer.write(make_record(0, calibration, bias=np.zeros((7, 9, 3, 2))))
    metadata = [*folder.rglob("zarr.json")]
    files = [*folder.glob("*.*"), *folder.rglob("*.npy"), *folder.joinpath("calibrations").rglob("*")]
    files += [*metadata, *(path.parent for path in metadata), tmp_path, folder / "calibrations"]
    lost = [path for path in files if path.stat().st_ino not in synced and path.name != "frames.jsonl"]
    assert not lost
    assert len(files) >= 14


@pytest.mark.posix
def test_files_are_on_disk_before_the_folders_that_name_them(
    tmp_path: Path, small_bench: SmallBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name that survives a power failure must lead to its contents."""
    folder, synced, named = tmp_path / "r", [], {}

    def note(file: int) -> None:
        path = Path(f"/proc/self/fd/{file}").resolve()
        synced.append(os.fstat(file).st_ino)
        if path.is_dir():
            named[path] = {each.name for each in path.iterdir()}

    monkeypatch.setattr(os, "fsync", note)
    with closing(RecordingWriter(folder, FACTS)) as writer:
        writer.write(make_record(0, noisy_calibration(small_bench)))
    number = {inode: number for number, inode in enumerate(synced)}
    last = {path: number[path.stat().st_ino] for path in [folder, *folder.rglob("*")] if path.stat().st_ino in number}
    for metadata in folder.rglob("zarr.json"):
        assert synced.index(metadata.stat().st_ino) < last[metadata.parent]
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
    inside = [recording.folder / "sub"]
    if os.name == "posix":  # Windows asks for rights to make a link
        (tmp_path / "link").symlink_to(recording.folder)
        inside.append(tmp_path / "link" / "calibrations" / "sub")
    for folder in inside:
        with pytest.raises(
            InputError, match=re.escape(f"lies in the recording {recording.folder}: choose another folder")
        ):
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


def test_share_without_file_locks_is_refused_with_a_remedy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], quick_toml: Path, tmp_path: Path
) -> None:
    def no_locks(_: int) -> bool:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("app.recording.folder.has_locked", no_locks)
    assert run(monkeypatch, "measure", "--bench", quick_toml, "--frames", "1", "--out", tmp_path / "run") == 1
    error = " ".join(capsys.readouterr().err.split())
    assert f"{os.strerror(errno.ENOLCK)}: use a folder on this computer's own disk, or mount the share with" in error
