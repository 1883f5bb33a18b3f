"""Benches in the window: open, recent, presets, and what is wrong with a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from PyQt6.QtCore import QSettings, Qt
from PyQt6.QtWidgets import QFileDialog, QMenu, QPushButton
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera, opener
from support.window_tools import press

from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench
from app.bench.presets import PRESETS
from app.errors import InputError
from app.gui.shell.main_window import MainWindow

LIBRARY = '[camera]\ndriver = "dcam"\nlibrary = \'{}\'\n[light]\ndriver = "manual"\n'


class Opened:
    """A window whose benches all have the fake camera."""

    def __init__(self, settings: QSettings) -> None:
        self.opened: list[Bench] = []
        self.cameras: list[FakeCamera] = []
        self.window = MainWindow(make_for=self._make, saved=settings)

    def _make(self, bench: Bench) -> Acquisition:
        self.opened.append(bench)
        self.cameras.append(FakeCamera())
        return Acquisition(bench, opener(self.cameras[-1]))

    def entries(self, title: str) -> dict[str, Callable[[], object]]:
        """Entries of a submenu, by their texts."""
        menu = next(menu for menu in self.window.findChildren(QMenu) if menu.title() == title)
        menu.aboutToShow.emit()
        return {action.text(): action.trigger for action in menu.actions() if action.isEnabled()}

    def button(self, text: str) -> QPushButton:
        """A button of the dialog."""
        buttons = self.window.benches.dialog.findChildren(QPushButton)
        return next(button for button in buttons if button.text() == text and not button.isHidden())


@pytest.fixture
def benches(make_window: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Opened]:  # noqa: ARG001 - checks that no widget survives
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    made = Opened(QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat))
    made.window.show()
    yield made
    made.window.close()
    made.window.deleteLater()


def is_live(benches: Opened, count: int) -> bool:
    controller = benches.window.controller
    return len(benches.opened) == count and controller.status is not None and controller.is_settled


@pytest.mark.slow
@pytest.mark.long
def test_preset_is_opened_and_another_bench_takes_its_place(
    benches: Opened, qtbot: QtBot, small_toml: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    presets = benches.entries("Open a preset")
    assert list(presets) == [name.replace("_", " ") for name in PRESETS]
    presets["small demo"]()
    qtbot.waitUntil(lambda: is_live(benches, 1))
    assert benches.opened == [load_bench("small_demo")]
    assert not benches.entries("Open a recent bench")  # presets have their own menu
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(small_toml), ""))
    benches.window.benches.ask()
    qtbot.waitUntil(lambda: is_live(benches, 2))
    assert benches.opened[1] == load_bench(small_toml)
    assert benches.cameras[0].is_closed
    assert not benches.cameras[0].light.shines
    recent = benches.entries("Open a recent bench")
    assert list(recent) == [f"{small_toml.name}  \N{EM DASH}  {small_toml.parent}"]
    next(iter(recent.values()))()
    qtbot.waitUntil(lambda: is_live(benches, 3))
    assert benches.opened[2] == benches.opened[1]


@pytest.mark.slow
def test_faulty_file_shows_its_line_until_it_is_corrected(
    benches: Opened, qtbot: QtBot, small_toml: Path, tmp_path: Path
) -> None:
    lines = small_toml.read_text().splitlines()
    index = lines.index("wavelength_m = 462e-9")
    path = tmp_path / "bad <bench>.toml"
    path.write_text("\n".join([*lines[:index], "wavelength_m = 462", *lines[index + 1 :]]))
    window, dialog = benches.window, benches.window.benches.dialog
    window.benches.open(str(path))
    qtbot.waitUntil(dialog.isVisible)
    assert dialog.windowTitle() == f"Faulty bench, line {index + 1}"
    text = dialog.text()
    assert "sensor.wavelength_m must be 1e-7 ... 2e-5" in text
    assert "bad &lt;bench&gt;.toml" in text
    marked = [part for part in text.split("<br>") if "&#9654;" in part]
    assert len(marked) == 1
    assert "wavelength_m&nbsp;=&nbsp;462<" in marked[0]
    benches.button("Try again").click()
    qtbot.waitUntil(dialog.isVisible)
    assert isinstance(window.benches.error, InputError)
    assert not benches.opened
    path.write_text(small_toml.read_text())
    benches.button("Try again").click()
    qtbot.waitUntil(lambda: is_live(benches, 1))
    assert window.benches.error is None
    assert not dialog.isVisible()


@pytest.mark.slow
@pytest.mark.long
def test_faulty_file_leaves_the_open_bench(benches: Opened, qtbot: QtBot, tmp_path: Path) -> None:
    benches.window.benches.open("small_demo")
    qtbot.waitUntil(lambda: is_live(benches, 1))
    benches.window.benches.open(str(tmp_path / "missing.toml"))
    qtbot.waitUntil(lambda: "no such file" in benches.window.benches.dialog.text())
    assert benches.cameras[0].light.shines
    assert len(benches.opened) == 1
    qtbot.waitUntil(benches.window.benches.dialog.isActiveWindow)
    press(qtbot, benches.window.benches.dialog, Qt.Key.Key_Escape)
    assert not benches.window.benches.dialog.isVisible()


def test_library_is_loaded_only_when_it_is_trusted(
    benches: Opened, qtbot: QtBot, small_toml: Path, tmp_path: Path
) -> None:
    library = tmp_path / "lib&lt;evil.so"
    library.write_bytes(b"code")
    text = small_toml.read_text()
    path = tmp_path / "named.toml"
    path.write_text(text[: text.index("[camera]")] + LIBRARY.format(library))
    for _ in range(2):  # closing the question is no answer
        benches.window.benches.open(str(path))
        qtbot.waitUntil(benches.window.benches.dialog.isVisible)
        assert "lib&amp;lt;evil" in benches.window.benches.dialog.text()
        benches.button("Close").click()
        assert not benches.opened
        assert benches.window.benches.error is not None
    benches.window.benches.open(str(path))
    qtbot.waitUntil(benches.window.benches.dialog.isVisible)
    benches.button("Trust and open").click()
    qtbot.waitUntil(lambda: len(benches.opened) == 1)
    benches.window.close()
    qtbot.waitUntil(lambda: benches.cameras[0].is_closed)


@pytest.mark.slow
@pytest.mark.long
def test_last_bench_is_offered_at_the_next_start(
    benches: Opened, qtbot: QtBot, small_toml: Path, tmp_path: Path
) -> None:
    window, path = benches.window, tmp_path / "lab.toml"
    path.write_text(small_toml.read_text())
    window.benches.open("small_demo")
    qtbot.waitUntil(lambda: is_live(benches, 1))
    window.benches.offer_last()  # a preset is not offered
    window.update_text()
    assert not window.messages.accept.isVisible()
    window.benches.open(str(path))
    qtbot.waitUntil(lambda: is_live(benches, 2))
    window.benches.open("small_demo")
    qtbot.waitUntil(lambda: is_live(benches, 3))
    window.benches.offer_last()
    window.update_text()
    assert window.messages.text.text() == 'The bench "lab.toml" was open last: open it again?'
    window.messages.accept.click()
    qtbot.waitUntil(lambda: is_live(benches, 4))
    assert benches.opened[3] == load_bench(path)
    path.unlink()
    window.benches.offer_last()
    window.update_text()
    assert not window.messages.accept.isVisible()


@pytest.mark.slow
@pytest.mark.long
def test_saved_bench_is_recent(benches: Opened, qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    benches.window.benches.open("small_demo")
    qtbot.waitUntil(lambda: is_live(benches, 1))
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(tmp_path / "mine.toml"), ""))
    benches.window.benches.save()
    qtbot.waitUntil(lambda: "Saved " in benches.window.messages.log)
    assert load_bench(tmp_path / "mine.toml").sensor == load_bench("small_demo").sensor
    assert benches.entries("Open a recent bench")
