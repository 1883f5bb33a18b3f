"""A recording that is renamed between two steps of reading it is read on under its new name."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.recordings import record

from app.errors import InputError
from app.recording.calibration_files import write_array
from app.recording.folder import BIAS
from app.recording.reader import Recording


@pytest.fixture(scope="module")
def recording(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Its refinement has found something."""
    made = record(small_toml, tmp_path_factory.mktemp("recording") / "run", frames=2)
    write_array(made.folder / BIAS.format(0), np.full((7, 7, 3, 2), 0.25))
    return made


@pytest.mark.parametrize(
    "read",
    [
        lambda of: of.line(1).host_time_s,
        lambda of: of.pixels(1),
        lambda of: of.displacement(1),
        lambda of: of.calibration(0).reference.mean,
        lambda of: of.bias(0),
        lambda of: of.start(1),
    ],
)
def test_everything_is_found_under_the_new_name(
    recording: Recording, tmp_path: Path, read: Callable[[Recording], Any]
) -> None:
    copy = Recording(shutil.copytree(recording.folder, tmp_path / "run"))
    copy.pixels(0)  # the array is open
    copy.folder.rename(tmp_path / "mouse 7")
    np.testing.assert_array_equal(read(copy), read(recording))
    assert copy.folder.name == "mouse 7"


def test_removed_recording_is_an_error(recording: Recording, tmp_path: Path) -> None:
    copy = Recording(shutil.copytree(recording.folder, tmp_path / "run"))
    shutil.rmtree(copy.folder)
    with pytest.raises(InputError, match="cannot be read"):
        copy.line(0)
    with pytest.raises(InputError, match="missing"):
        copy.pixels(0)
    with pytest.raises(InputError, match="no such file"):
        copy.calibration(0)
