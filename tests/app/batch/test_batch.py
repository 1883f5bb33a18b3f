"""Batches in one process: the same results as a replay, only what is missing, failures by recording."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.batches import QUICK, Counting, assert_equals_replay, batch, files_of, small_blocks
from support.command_line import run
from support.recordings import edit_line, record, replace_pixels
from support.records import frame_file

import svwfs
from app import files
from app.batch.store import BatchJob, unique_names
from app.bench.config import load_bench, write_bench
from app.bench.imaging_model import BenchModel
from app.commands.batch import print_batch
from app.errors import InputError, Interrupted, RunError
from app.recording.reader import Recording
from app.recording.reprocess import Reprocessing
from reconstruction.refinement import Refinement

BLOCK = 4


@pytest.fixture(scope="module")
def recordings(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Recording]:
    """Three blocks, the last of one frame; and one block."""
    folder = tmp_path_factory.mktemp("recordings")
    return [record(small_toml, folder / name, *QUICK, frames=frames) for name, frames in (("long", 9), ("short", 3))]


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    small_blocks(monkeypatch, BLOCK)


@pytest.fixture
def mine(recordings: list[Recording], tmp_path: Path) -> Recording:
    """A copy that a test may damage."""
    copy = shutil.copytree(recordings[0].folder, tmp_path / "mine")
    run = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps({**run, "began": "another day"}))
    return Recording(copy)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("setting", [(), ("registration.warp=translation",)])
def test_results_are_those_of_a_replay(recordings: list[Recording], tmp_path: Path, setting: tuple[str, ...]) -> None:
    """Also with another registration, where each frame starts from the one before in its block."""
    made = batch(tmp_path / "r.zarr", *recordings, job=BatchJob(settings=setting))
    assert (made.frames, made.wavefronts, made.computed, made.failed) == (12, 12, 12, {})
    for recording in recordings:
        assert_equals_replay(tmp_path / "r.zarr", recording, tmp_path, *setting)


@pytest.mark.slow
@pytest.mark.long
def test_another_bench_is_that_of_a_replay(recordings: list[Recording], small_toml: Path, tmp_path: Path) -> None:
    other = load_bench(small_toml, (*QUICK, "reconstruction.method=zonal"))
    batch(tmp_path / "r.zarr", recordings[1], job=BatchJob(bench=write_bench(other)))
    assert_equals_replay(tmp_path / "r.zarr", recordings[1], tmp_path, "reconstruction.method=zonal")
    with xr.open_zarr(tmp_path / "r.zarr") as stored:
        assert "coefficients" not in stored


@pytest.mark.slow
@pytest.mark.long
def test_frames_are_refined_by_the_model(recordings: list[Recording], tmp_path: Path) -> None:
    batch(tmp_path / "r.zarr", recordings[1], job=BatchJob(rounds=2))
    recording = recordings[1]
    calibration = recording.calibration(0)
    reconstructor = calibration.reconstructor()
    refinement = Refinement(reconstructor, BenchModel(calibration.bench, reconstructor, threads=1))
    registered = None  # of the frame before, from which the registration starts
    with xr.open_zarr(tmp_path / "r.zarr") as stored:
        for index in range(len(recording)):
            registered = reconstructor.register(recording.pixels(index), start=registered)
            *_, last = refinement.rounds(registered, 2)
            np.testing.assert_allclose(stored["wavefront"][0, index], last.wavefront.views, atol=1e-4)
            np.testing.assert_array_equal(stored["bias_age"][0, index], 0.0)
        (whole,) = [made.wavefront for made in Reprocessing(recording, rounds=2)([2])]
        assert whole is not None
        np.testing.assert_array_equal(stored["wavefront"][0, 2], whole.views)


@pytest.mark.slow
def test_store_opens_as_one_dataset_with_its_origin(recordings: list[Recording], tmp_path: Path) -> None:
    batch(tmp_path / "r.zarr", *recordings)
    with svwfs.open_result(tmp_path / "r.zarr") as stored:
        assert stored["wavefront"].dims[:2] == ("recording", "frame")
        assert stored.sizes["frame"] == 9
        assert stored["recording"].to_numpy().tolist() == ["long", "short"]
        np.testing.assert_array_equal(stored["frames"], [9, 3])
        np.testing.assert_array_equal(stored["state"], [[1] * 9, [1] * 3 + [0] * 6])
        assert bool(np.isnan(stored["wavefront"].sel(recording="short")[3:]).all())
        assert {"view_x", "pupil_y", "time", "bias_age"} <= set(stored.coords)
        origin = json.loads(stored["provenance"].sel(recording="short").to_numpy().item())
    assert origin["folder"] == str(recordings[1].folder)
    assert origin["frames"] == 3
    assert "[sensor]" in origin["bench"]
    assert {"svwfs", "numpy", "numba"} <= set(origin["versions"])
    assert origin["machine"]["cores"] >= 1


def test_folder_without_results_cannot_be_opened(recordings: list[Recording], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no results of svwfs batch; svwfs.open_recording opens a recording"):
        svwfs.open_result(recordings[0].folder)
    batch(tmp_path / "r.zarr", recordings[1])
    (tmp_path / "r.zarr" / "zarr.json").write_text('{"attributes": {"format": "svwfs batch 1", "job": {}}}')
    with pytest.raises(InputError, match="cannot be read as results of svwfs batch"):
        svwfs.open_result(tmp_path / "r.zarr")


@pytest.mark.slow
@pytest.mark.long
def test_second_run_does_only_what_is_missing(recordings: list[Recording], tmp_path: Path) -> None:
    out = tmp_path / "r.zarr"
    batch(out, *recordings)
    before = files_of(out)
    (out / "state/c/0/1").unlink()  # as if a worker had been killed before it finished the block
    (out / "wavefront/c/0/1/0/0/0/0").unlink()
    made = batch(out, *recordings, evaluate=(counting := Counting()))
    assert (counting.items, made.computed, made.frames) == (1, 4, 12)
    after = files_of(out)
    assert {name: contents for name, (_, contents) in after.items()} == {
        name: contents for name, (_, contents) in before.items()
    }
    rewritten = {name for name in after if after[name][0] != before[name][0]}
    assert {name.split("/c/")[1][:3] for name in rewritten} == {"0/1"}
    assert batch(out, *recordings, evaluate=(counting := Counting())).computed == counting.items == 0


@pytest.mark.slow
@pytest.mark.long
def test_more_and_longer_recordings_are_added(recordings: list[Recording], tmp_path: Path) -> None:
    out, whole = tmp_path / "r.zarr", tmp_path / "whole.zarr"
    batch(out, recordings[1])
    made = batch(out, recordings[0], recordings[0])
    assert (made.recordings, made.computed) == (1, 9)
    batch(whole, recordings[1], recordings[0])
    with xr.open_zarr(out) as one, xr.open_zarr(whole) as other:
        xr.testing.assert_identical(one.drop_vars("provenance"), other.drop_vars("provenance"))


@pytest.mark.slow
@pytest.mark.long
def test_interrupted_run_is_continued(recordings: list[Recording], tmp_path: Path) -> None:
    out = tmp_path / "r.zarr"

    def interrupt(items: int) -> None:
        if items == 3:  # the first was to make the store
            raise Interrupted("interrupted")

    with pytest.raises(Interrupted, match=r"8 of 12 frames are in .*r.zarr, the same command does the rest"):
        batch(out, *recordings, evaluate=Counting(interrupt))
    made = batch(out, *recordings)
    assert made.computed == 4
    assert_equals_replay(out, recordings[0], tmp_path)


def _cut_pixels(mine: Recording) -> None:
    path = frame_file(mine.folder, 6)
    path.write_bytes(path.read_bytes()[:100])


def _flip_bit(mine: Recording) -> None:
    path = frame_file(mine.folder, 6)
    held = path.read_bytes()
    path.write_bytes(held[:100] + bytes([held[100] ^ 1]) + held[101:])


def _lose_lines(mine: Recording) -> None:
    path = mine.folder / "frames.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:5]))


def _edit_run(**changes: object) -> Callable[[Recording], None]:
    def edit(mine: Recording) -> None:
        path = mine.folder / "run.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))

    return edit


DAMAGES: dict[str, tuple[Callable[[Recording], object], str]] = {
    "lost lines": (_lose_lines, "4 of 9 frames have no line; svwfs recover"),
    "no calibration": (lambda mine: shutil.rmtree(mine.folder / "calibrations"), "calibrations"),
    "cut short": (_edit_run(complete=False), "is not complete"),
    "no number of frames": (_edit_run(frames=None), "does not say how many frames it has"),
    "no frame": (_edit_run(frames={"recorded": 0}), "holds no frame"),
    "no recording": (lambda mine: shutil.rmtree(mine.folder), "no such folder"),
}


DAMAGED_FRAMES: dict[str, tuple[Callable[[Recording], object], str]] = {
    "half a frame": (_cut_pixels, "is damaged: 100 bytes"),
    "a flipped bit": (_flip_bit, "the pixels of frame 6 are not those that were recorded"),
    "no pixels": (lambda mine: frame_file(mine.folder, 6).unlink(), "pixels of frame 6 are missing"),
    "a damaged line": (lambda mine: edit_line(mine, 6, lost="many"), "line 7 is damaged"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGED_FRAMES)
def test_damaged_frame_costs_itself_alone(
    recordings: list[Recording], mine: Recording, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    damage, sentence = DAMAGED_FRAMES[name]
    damage(mine)
    out = tmp_path / "r.zarr"
    made = batch(out, mine, recordings[1])
    assert (made.failed, made.frames, made.wavefronts) == ({}, 12, 11)
    assert sentence in made.damaged[mine.folder][0]
    print_batch(made, out)
    assert "mine: 1 frame damaged and left out" in " ".join(capsys.readouterr().out.split())
    with xr.open_zarr(out) as stored:
        assert stored["state"].sel(recording="mine").to_numpy().tolist() == [1] * 6 + [3] + [1] * 2
        assert np.flatnonzero(stored["rms"].sel(recording="mine").isnull().any(("view_row", "view_column"))) == [6]


@pytest.mark.slow
def test_exit_status_tells_of_damaged_frames(
    mine: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _flip_bit(mine)
    monkeypatch.setattr("app.batch.workers.workers", lambda *_, **_options: nullcontext(Counting()))
    assert run(monkeypatch, "batch", mine.folder, "--out", tmp_path / "r.zarr") == 1
    said = capsys.readouterr()
    assert "mine: 1 frame damaged and left out" in said.out
    assert said.err.endswith("svwfs: 1 frame damaged and left out\n")


@pytest.mark.slow
@pytest.mark.long
def test_some_frames_of_each_recording(recordings: list[Recording], tmp_path: Path) -> None:
    """From the middle of a block to the middle of another; the values are those of all frames."""
    out, whole = tmp_path / "r.zarr", tmp_path / "whole.zarr"
    made = batch(out, *recordings, job=BatchJob(frames="3:7"))
    assert "selects no frame" in made.failed[recordings[1].folder]
    assert (made.frames, made.wavefronts, made.computed) == (4, 4, 4)
    batch(whole, recordings[0])
    with xr.open_zarr(out) as some, xr.open_zarr(whole) as stored:
        assert some["state"].to_numpy().tolist() == [[0] * 3 + [1] * 4 + [0] * 2]
        np.testing.assert_array_equal(some["wavefront"][0, 3:7], stored["wavefront"][0, 3:7])
        assert bool(np.isnan(some["wavefront"][0, :3]).all())
    with pytest.raises(InputError, match="differ from these in frames"):
        batch(out, recordings[0])
    with pytest.raises(InputError, match="write FIRST:END"):
        batch(tmp_path / "none.zarr", *recordings, job=BatchJob(frames="4-7"))


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_recording_is_named_while_the_others_complete(
    recordings: list[Recording], mine: Recording, tmp_path: Path, name: str
) -> None:
    damage, sentence = DAMAGES[name]
    damage(mine)
    out = tmp_path / "r.zarr"
    made = batch(out, mine, recordings[1])
    assert list(made.failed) == [mine.folder]
    assert sentence in made.failed[mine.folder]
    assert (made.recordings, made.frames, made.wavefronts) == (2, 3, 3)
    with xr.open_zarr(out) as stored:
        if "mine" in stored["recording"]:
            assert sentence in json.loads(stored["provenance"].sel(recording="mine").to_numpy().item())["failed"]


@pytest.mark.slow
@pytest.mark.long
def test_repaired_recording_is_completed(recordings: list[Recording], mine: Recording, tmp_path: Path) -> None:
    out, kept = tmp_path / "r.zarr", mine.pixels(6)
    _cut_pixels(mine)
    assert batch(out, recordings[1], mine).damaged
    assert batch(out, recordings[1], mine).damaged  # said again
    replace_pixels(mine, 6, kept)
    made = batch(out, recordings[1], mine)
    assert (made.failed, made.damaged, made.frames, made.wavefronts) == ({}, {}, 12, 12)
    assert made.computed < 9  # the blocks before the damage were there
    with xr.open_zarr(out) as stored:
        assert stored["state"].sel(recording="mine").to_numpy().tolist() == [1] * 9


@pytest.mark.slow
@pytest.mark.long
def test_frames_without_a_wavefront_are_told_and_done(mine: Recording, tmp_path: Path) -> None:
    for index in (0, 4, 5, 6, 7):  # the first, and a whole block
        replace_pixels(mine, index, np.full_like(mine.pixels(index), 500))
    out = tmp_path / "r.zarr"
    made = batch(out, mine)
    assert (made.frames, made.wavefronts) == (9, 4)
    assert "is the light on?" in made.problem
    assert_equals_replay(out, mine, tmp_path)
    with xr.open_zarr(out) as stored:
        np.testing.assert_array_equal(stored["state"][0], [2, 1, 1, 1, 2, 2, 2, 2, 1])
        assert bool(np.isnan(stored["rms"][0, 4:8]).all())
    assert batch(out, mine).computed == 0


@pytest.mark.slow
@pytest.mark.long
def test_other_sizes_do_not_fit(recordings: list[Recording], small_toml: Path, tmp_path: Path) -> None:
    """Other views, and as many at other places."""
    fewer = record(small_toml, tmp_path / "fewer", *QUICK, "field.view_rows=2", frames=2)
    wider = record(small_toml, tmp_path / "wider", *QUICK, "field.view_spacing_m=0.3e-3", frames=2)
    made = batch(tmp_path / "r.zarr", recordings[1], fewer, wider)
    assert "another view_row" in made.failed[fewer.folder]
    assert "another view_x and view_y" in made.failed[wider.folder]
    assert made.wavefronts == 3


@pytest.mark.parametrize(
    ("job", "named"),
    [(BatchJob(rounds=1), "rounds"), (BatchJob(settings=("reconstruction.pupil_modes=10",)), "settings")],
)
def test_store_keeps_to_its_settings(recordings: list[Recording], tmp_path: Path, job: BatchJob, named: str) -> None:
    batch(tmp_path / "r.zarr", recordings[1])
    with pytest.raises(InputError, match=f"differ from these in {named}: repeat those options, or give another --out"):
        batch(tmp_path / "r.zarr", recordings[1], job=job)


def test_worker_with_another_version_ends_the_run(recordings: list[Recording], tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"another version than svwfs 0.0.1: install the same everywhere"):
        batch(tmp_path / "r.zarr", recordings[1], job=BatchJob(software="svwfs 0.0.1"))


@pytest.mark.slow
def test_changed_recording_is_refused(recordings: list[Recording], mine: Recording, tmp_path: Path) -> None:
    batch(tmp_path / "r.zarr", mine)
    _edit_run(note="edited")(mine)
    made = batch(tmp_path / "r.zarr", mine, recordings[1])
    assert "has changed since its results were written" in made.failed[mine.folder]
    assert (made.recordings, made.wavefronts) == (2, 3)


@pytest.mark.slow
def test_moved_recording_is_recognised(mine: Recording, tmp_path: Path) -> None:
    batch(tmp_path / "r.zarr", mine)
    moved = mine.folder.rename(tmp_path / "moved")
    assert batch(tmp_path / "r.zarr", moved).computed == 0


def test_identical_recordings_are_named(mine: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = shutil.copytree(mine.folder, tmp_path / "copy")
    made = batch(tmp_path / "r.zarr", mine, copy, mine)
    assert (made.recordings, made.copies) == (1, {copy: mine.folder})
    print_batch(made, tmp_path / "r.zarr")
    assert "is a copy of" in " ".join(capsys.readouterr().out.split())


def test_nothing_but_a_store_is_written_into(recordings: list[Recording], mine: Recording, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "letter.txt").write_text("")
    for out, sentence in (
        (tmp_path / "folder", "exists already and holds no results of svwfs batch"),
        (tmp_path / "folder" / "letter.txt", "is a file"),
        (mine.folder / "frames.zarr", "lies in the recording"),
        (recordings[1].folder / "frames.zarr", "exists already and holds no results of svwfs batch"),
    ):
        with pytest.raises(InputError, match=sentence):
            batch(out, mine)


def test_second_writer_is_refused(recordings: list[Recording], tmp_path: Path) -> None:
    def another(_: int) -> None:
        with pytest.raises(InputError, match="another svwfs batch is writing into it"):
            batch(tmp_path / "r.zarr", recordings[1])

    batch(tmp_path / "r.zarr", recordings[1], evaluate=(counting := Counting(another)))
    assert counting.items == 2
    assert not (tmp_path / ".r.zarr.lock").exists()


def test_batch_without_any_result_leaves_nothing(mine: Recording, tmp_path: Path) -> None:
    shutil.rmtree(mine.folder / "calibrations")
    with pytest.raises(RunError, match=r"there is nothing to write: .*calibrations"):
        batch(tmp_path / "r.zarr", mine)
    with pytest.raises(InputError, match="nowhere: no such folder"):
        batch(tmp_path / "r.zarr", tmp_path / "nowhere")
    assert not (tmp_path / "r.zarr").exists()


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("last", "left"), [("state/c/0/1", 4), ("wavefront/c/0/1", 8)])
def test_full_disk_ends_the_run_and_keeps_what_is_there(
    recordings: list[Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last: str, left: int
) -> None:
    """A block counts when its last file is there, and that is the chunk of `state`."""
    out, sync = tmp_path / "r.zarr", files.sync

    def fill(path: Path) -> None:
        if (out / last).exists():
            raise OSError(28, "No space left on device")  # the file has its name, but nobody was told
        sync(path)

    with monkeypatch.context() as patch:
        patch.setattr(files, "sync", fill)
        with pytest.raises(RunError, match=r"No space left on device; 4 of 12 frames are in .*the same command"):
            batch(out, *recordings)
    assert batch(out, *recordings).computed == left
    assert_equals_replay(out, recordings[0], tmp_path)


@pytest.mark.slow
@pytest.mark.long
def test_first_frame_of_a_block_is_judged_beside_the_one_before(mine: Recording, tmp_path: Path) -> None:
    """A frozen camera repeats frames also across the border of two blocks."""
    replace_pixels(mine, BLOCK, mine.pixels(BLOCK - 1))
    batch(tmp_path / "r.zarr", mine)
    with xr.open_zarr(tmp_path / "r.zarr") as stored:
        faults = stored["quality"][0].to_numpy()
    assert faults[BLOCK] != 0
    assert not np.delete(faults, BLOCK).any()
    assert_equals_replay(tmp_path / "r.zarr", mine, tmp_path)


def test_names_are_as_short_as_they_can_be_told_apart() -> None:
    folders = [Path("/x/monday/run1"), Path("/x/tuesday/run1"), Path("/y/tuesday/run1"), Path("/run1"), Path("/run1")]
    names = unique_names(folders, ["run2", "monday/run1"])
    assert names == ["run1", "tuesday/run1", "y/tuesday/run1", "run1-2", "run1-3"]
