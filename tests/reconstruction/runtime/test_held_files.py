"""Renaming while another program holds the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from reconstruction.runtime import renaming
from reconstruction.runtime.renaming import rename


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Targets that were asked for; the first two attempts fail, as while a virus scanner reads the file."""
    asked: list[Path] = []
    replace = Path.replace

    def refusing(source: Path, target: Path) -> Path:
        asked.append(target)
        if len(asked) < 3:
            raise PermissionError(13, "used by another process")
        return replace(source, target)

    monkeypatch.setattr(Path, "replace", refusing)
    return asked


def test_windows_tries_again(tmp_path: Path, held: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reconstruction.runtime.renaming.sys.platform", "win32")
    (tmp_path / "new").write_text("new")
    (tmp_path / "old").write_text("old")
    rename(tmp_path / "new", tmp_path / "old")
    assert (tmp_path / "old").read_text() == "new"
    assert held == [tmp_path / "old"] * 3


def test_windows_gives_up_in_the_end(tmp_path: Path, held: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reconstruction.runtime.renaming.sys.platform", "win32")
    monkeypatch.setattr(renaming, "_HELD_S", -1.0)
    with pytest.raises(PermissionError):
        rename(tmp_path, tmp_path / "other")
    assert len(held) == 1


def test_other_systems_refuse_at_once(tmp_path: Path, held: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reconstruction.runtime.renaming.sys.platform", "linux")
    with pytest.raises(PermissionError):
        rename(tmp_path, tmp_path / "other")
    assert len(held) == 1
