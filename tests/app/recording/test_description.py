"""Name and note of a finished recording."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.records import make_record, write

from app.errors import InputError
from app.recording.folder import describe, name_problem
from app.recording.reader import Recording


def finished(folder: Path) -> Path:
    write(folder, [make_record(index) for index in range(3)])
    return folder


def test_name_follows_the_time_and_can_be_changed(tmp_path: Path) -> None:
    folder = finished(tmp_path / "20261122-130100-kept-2")
    named = describe(folder, name=" mouse 7 ", note="")
    assert named == tmp_path / "20261122-130100-kept-2-mouse 7"
    assert len(Recording(named)) == 3
    assert describe(named, name="rat", note="") == tmp_path / "20261122-130100-kept-2-rat"
    assert describe(tmp_path / "20261122-130100-kept-2-rat", name="", note="") == folder
    assert list(tmp_path.iterdir()) == [folder]


def test_note_is_kept_beside_the_facts(tmp_path: Path) -> None:
    folder = finished(tmp_path / "run1")
    before = Recording(folder).run
    assert describe(folder, name="", note="3 % agarose\n") == folder
    assert Recording(folder).run == {**before, "note": "3 % agarose"}
    describe(folder, name="", note="")
    assert Recording(folder).run["note"] == ""


def test_opened_recording_is_found_under_its_new_name(tmp_path: Path) -> None:
    """Also beside a folder that cannot be read as a recording."""
    folder = finished(tmp_path / "20261122-130100")
    opened = Recording(folder)
    line, pixels = opened.line(1), opened.pixels(2)
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name in ("broken", "of another bench"):
        write(tmp_path / name, [make_record(0)])
    (tmp_path / "broken" / "run.json").write_text("{")
    named = describe(folder, name="mouse 7", note="fed")
    assert opened.line(1) == line
    assert opened.folder == named
    np.testing.assert_array_equal(opened.pixels(2), pixels)
    shutil.rmtree(named)
    with pytest.raises(InputError, match=r"mouse 7[/\\]frames\.jsonl: cannot be read: No such file"):
        opened.line(0)


@pytest.mark.parametrize("name", ["a/b", "..", ".hidden", "a\\b", "x" * 101, 'a"b', "a.", "CON", "nul.txt"])
def test_impossible_name_is_refused(tmp_path: Path, name: str) -> None:
    folder = finished(tmp_path / "20261122-130100")
    with pytest.raises(InputError, match="a name of a recording"):
        describe(folder, name=name, note="kept")
    assert name_problem(name)
    assert not name_problem("mouse 7")
    assert Recording(folder).run["note"] == "kept"


def test_taken_name_is_refused(tmp_path: Path) -> None:
    folder = finished(tmp_path / "20261122-130100")
    (tmp_path / "20261122-130100-taken").mkdir()
    with pytest.raises(InputError, match="exists already"):
        describe(folder, name="taken", note="")
    assert len(Recording(folder)) == 3


def test_growing_recording_is_refused(tmp_path: Path) -> None:
    folder = finished(tmp_path / "20261122-130100")
    run = folder / "run.json"
    run.write_text(json.dumps({**json.loads(run.read_text()), "complete": False}))
    with pytest.raises(InputError, match="still being recorded"):
        describe(folder, name="x", note="")
