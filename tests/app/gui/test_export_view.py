"""Export of the shown wavefronts, and the badge of simulated benches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from PyQt6.QtGui import QAction, QImage
from PyQt6.QtWidgets import QFileDialog, QMessageBox, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import SENSOR, FakeCamera
from support.window_tools import MakeWindow

from app.bench.config import load_bench
from app.gui.shell.main_window import MainWindow


def export(window: MainWindow, monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(path), ""))
    next(each for each in window.findChildren(QAction) if each.text() == "Export the shown wavefronts…").trigger()


@pytest.mark.slow
@pytest.mark.long
def test_picture_and_results_are_those_that_are_shown(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    window.controls.start.click()
    qtbot.waitUntil(lambda: window.controls.start.text() == "Start")
    for number in (2, 3):
        window.panels.wavefronts.menu.removed[number].trigger()
    window.panels.wavefronts.menu.change(views=2)
    export(window, monkeypatch, tmp_path / "seen.png")
    qtbot.waitUntil(lambda: f"Saved {tmp_path / 'seen.png'} and seen.nc" in window.messages.log)
    shown = window.shown.wavefront
    assert shown is not None
    image = QImage(str(tmp_path / "seen.png"))
    assert image.width() == round(window.panels.wavefronts.width() * window.devicePixelRatioF())
    with xr.open_dataset(tmp_path / "seen.nc") as results:
        np.testing.assert_array_equal(results["wavefront"].values, shown.views)
        assert results["wavefront"].shape[:2] == (2, 2)
        assert results.attrs["display"] == "no tilt"
        views, column = (results["wavefront"].values, np.arange(SENSOR.lenslets[1]) - (SENSOR.lenslets[1] - 1) / 2)
    assert np.abs(np.sum(views * column, axis=(2, 3))).max() < 1e-6  # least squares leave no tilt


@pytest.mark.slow
def test_existing_files_are_replaced_only_when_asked(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name is typed without its suffix: the file dialog could not have asked."""
    window, _ = live
    for name in ("seen.nc", "seen.png"):
        (tmp_path / name).write_text("mine")
    answers, asked = [QMessageBox.StandardButton.Yes, QMessageBox.StandardButton.Cancel], list[str]()

    def ask(_parent: QWidget, _title: str, question: str, *_: object) -> QMessageBox.StandardButton:
        asked.append(question)
        return answers.pop()

    monkeypatch.setattr(QMessageBox, "question", ask)
    export(window, monkeypatch, tmp_path / "seen")
    assert asked == ["seen.png and seen.nc exist already. Replace?"]
    assert {path.read_text() for path in tmp_path.iterdir()} == {"mine"}
    export(window, monkeypatch, tmp_path / "seen")
    qtbot.waitUntil(lambda: "Saved" in window.messages.log)
    assert {path.name for path in tmp_path.iterdir() if path.read_bytes() != b"mine"} == {"seen.nc", "seen.png"}


@pytest.mark.slow
def test_names_with_numbers_stay_apart_and_other_suffixes_are_refused(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    for name in ("tilt_0.5", "tilt_0.7"):
        export(window, monkeypatch, tmp_path / name)
        qtbot.waitUntil(lambda name=name: f"{name}.png and {name}.nc" in window.messages.log)  # type: ignore[misc] # mypy and defaults
    refused = list[str]()
    monkeypatch.setattr(QMessageBox, "warning", lambda _parent, _title, why: refused.append(why))
    export(window, monkeypatch, tmp_path / "shown.csv")
    assert refused == ["shown.csv: the name must end with .png"]
    files = {f"tilt_0.{tenths}.{kind}" for tenths in (5, 7) for kind in ("png", "nc")}
    assert {path.name for path in tmp_path.iterdir()} == files


def test_nothing_to_export_is_announced(make_window: MakeWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    window = make_window()
    export(window, monkeypatch, Path("/nowhere/x.png"))
    assert "There is no wavefront to export" in window.messages.log


@pytest.mark.slow
def test_simulated_bench_is_marked(live: tuple[MainWindow, FakeCamera]) -> None:
    """The bench of the fake camera names no driver, so it counts as simulated."""
    window, _ = live
    assert window.windowTitle().endswith("SIMULATED")
    assert load_bench("live_demo").is_simulated
