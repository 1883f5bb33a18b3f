"""Recently used files: their order, their number, and what is left of them after a restart."""

from __future__ import annotations

from pathlib import Path

import pytest
from PyQt6.QtCore import QSettings

from app.gui.shell.menus import RecentFiles

_KEY = "recent/benches"


def stored(folder: Path) -> QSettings:
    return QSettings(str(folder / "settings.ini"), QSettings.Format.IniFormat)


def made(folder: Path, name: str) -> Path:
    path = folder / name
    path.touch()
    return path


@pytest.mark.parametrize("is_stored", [True, False])
def test_newest_comes_first_and_only_once(tmp_path: Path, *, is_stored: bool) -> None:
    recent = RecentFiles(stored(tmp_path) if is_stored else None, _KEY)
    first, second = made(tmp_path, "a, first.toml"), made(tmp_path, "second.toml")
    for path in (first, second, first):
        recent.add(path)
    assert recent.paths() == (first, second)


@pytest.mark.parametrize("count", [1, 3])
def test_paths_survive_a_restart(tmp_path: Path, count: int) -> None:
    settings = stored(tmp_path)
    paths = [made(tmp_path, f"{index}, of the set.toml") for index in range(count)]
    for path in paths:
        RecentFiles(settings, _KEY).add(path)
    settings.sync()
    assert RecentFiles(stored(tmp_path), _KEY).paths() == tuple(reversed(paths))


def test_ninth_path_replaces_the_oldest(tmp_path: Path) -> None:
    recent = RecentFiles(stored(tmp_path), _KEY)
    paths = [made(tmp_path, f"{index}.toml") for index in range(9)]
    for path in paths:
        recent.add(path)
    assert recent.paths() == tuple(reversed(paths[1:]))


def test_removed_files_are_left_out(tmp_path: Path) -> None:
    recent = RecentFiles(stored(tmp_path), _KEY)
    kept, removed = made(tmp_path, "kept.toml"), made(tmp_path, "removed.toml")
    recent.add(kept)
    recent.add(removed)
    removed.unlink()
    assert recent.paths() == (kept,)


def test_relative_path_is_found_from_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = made(tmp_path, "bench.toml")
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    recent = RecentFiles(stored(tmp_path), _KEY)
    recent.add(Path("bench.toml"))
    monkeypatch.chdir(tmp_path / "other")
    assert recent.paths() == (path,)


@pytest.mark.parametrize("value", [7, "", ["", "gone"], {"a": 1}])
def test_damaged_value_is_an_empty_list(tmp_path: Path, value: object) -> None:
    settings = stored(tmp_path)
    settings.setValue(_KEY, value)
    recent = RecentFiles(settings, _KEY)
    assert recent.paths() == ()
    recent.add(made(tmp_path, "new.toml"))
    assert len(recent.paths()) == 1
