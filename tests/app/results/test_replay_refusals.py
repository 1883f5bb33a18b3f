"""Replays of damaged recordings and with impossible options: refused in one line."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.recordings import edit_line, record
from support.records import frame_file

from app.recording.reader import Recording


@pytest.fixture(scope="module")
def plain(quick_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(quick_toml, tmp_path_factory.mktemp("recording") / "plain", frames=8)


@pytest.fixture
def mine(plain: Recording, tmp_path: Path) -> Recording:
    """A copy that a test may damage."""
    return Recording(shutil.copytree(plain.folder, tmp_path / "mine"))


MISTAKES: dict[str, tuple[tuple[str, ...], str]] = {
    "verify and another bench": (("--verify", "--set", "registration.warp=affine"), "leave --bench and --set out"),
    "no frame": (("--frames", "8:"), '--frames "8:" selects no frame; .* has 8'),
    "one number": (("--frames", "5"), "write FIRST:END"),
    "no number": (("--frames", "a:b"), "write FIRST:END"),
    "backwards": (("--frames", "-3:2"), "selects no frame"),
    "nothing": (("--frames", ""), "write FIRST:END"),
    "an unknown setting": (
        ("--set", "registration.wrap=affine"),
        r"the recorded bench: registration\.wrap is an unknown",
    ),
    "no such bench": (("--bench", "nowhere.toml"), "nowhere.toml: no such file"),
    "another sensor": (("--bench", "paper_simulation"), "does not fit this bench"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_one_line(
    plain: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    arguments, sentence = MISTAKES[name]
    assert run(monkeypatch, "replay", plain.folder, *arguments) == 2
    said = capsys.readouterr().err
    assert re.search(sentence, said)
    assert said.count("\n") == 1


def _misshape_bias(mine: Recording) -> None:
    (mine.folder / "biases").mkdir()
    np.save(mine.folder / "biases" / "0.npy", np.zeros((3, 7, 6, 2)))
    edit_line(mine, 1, bias=0)


def _truncate(mine: Recording) -> None:
    path = frame_file(mine.folder, 1)
    path.write_bytes(path.read_bytes()[:100])


FAULTS: dict[str, tuple[Callable[[Recording], object], str]] = {
    "no frames": (lambda mine: (mine.folder / "frames.jsonl").write_text(""), "holds no frame"),
    "no recording": (lambda mine: (mine.folder / "run.json").unlink(), "holds no recording"),
    "half a frame": (_truncate, "is damaged"),
    "no calibration": (lambda mine: shutil.rmtree(mine.folder / "calibrations"), "calibrations"),
    "a bias of other lenslets": (_misshape_bias, "bias 0 has other lenslets"),
    "a sample whose covariance has another size": (
        lambda mine: edit_line(mine, 1, sample={"ratios": [-0.97, 0.3], "covariance": [[1e-6]]}),
        "line 2 is damaged",
    ),
    "a negative exposure": (lambda mine: edit_line(mine, 1, exposure_s=-5.0), "line 2 is damaged"),
    "a bias that is not there": (lambda mine: edit_line(mine, 1, bias=7), "7.npy: no such file"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_damaged_recording_is_one_line(
    mine: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    damage, sentence = FAULTS[name]
    damage(mine)
    assert run(monkeypatch, "replay", mine.folder) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1


def test_text_of_a_recording_brings_no_control_codes(
    mine: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    edit_line(mine, 2, problem="\x1b[31m")
    assert run(monkeypatch, "replay", mine.folder) == 0
    printed = capsys.readouterr().out
    assert 'frame 2: the problem was "\\x1b[31m"' in printed
    assert "\x1b[31m" not in printed
