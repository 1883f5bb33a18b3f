"""A recording that is renamed between two steps of reading it is read on under its new name."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.recordings import record

from app.errors import InputError
from app.recording.reader import Recording


@pytest.fixture(scope="module")
def recording(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(small_toml, tmp_path_factory.mktemp("recording") / "run", frames=2)


@pytest.fixture
def renamed(recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recording:
    """A copy that gets another name as soon as someone has seen that it has the old one."""
    copy = Recording(shutil.copytree(recording.folder, tmp_path / "run"))
    exists = Path.exists

    def rename_after(path: Path) -> bool:
        was_there = exists(path)
        if was_there and path == tmp_path / "run":
            path.rename(tmp_path / "mouse 7")
        return was_there

    monkeypatch.setattr(Path, "exists", rename_after)
    return copy


def test_line_is_found_under_the_new_name(recording: Recording, renamed: Recording) -> None:
    assert renamed.line(1) == recording.line(1)
    assert renamed.folder.name == "mouse 7"


@pytest.mark.parametrize("read", [lambda of: of.pixels(1), lambda of: of.calibration(0).reference.mean])
def test_what_is_read_after_the_line_is_found_under_the_new_name(
    recording: Recording, tmp_path: Path, read: Callable[[Recording], NDArray[np.float32]]
) -> None:
    copy = Recording(shutil.copytree(recording.folder, tmp_path / "run"))
    copy.pixels(0)  # the array is open
    copy.folder.rename(tmp_path / "mouse 7")
    np.testing.assert_array_equal(read(copy), read(recording))


def test_removed_recording_is_an_error(recording: Recording, tmp_path: Path) -> None:
    copy = Recording(shutil.copytree(recording.folder, tmp_path / "run"))
    shutil.rmtree(copy.folder)
    with pytest.raises(InputError, match="cannot be read"):
        copy.line(0)
    with pytest.raises(InputError, match="missing"):
        copy.pixels(0)
    with pytest.raises(InputError, match="no such file"):
        copy.calibration(0)
