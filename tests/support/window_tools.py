"""Windows for tests: fixtures, pictures, keys and clicks."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from numpy.typing import NDArray
from PyQt6.QtCore import QPoint, QRect, QSettings, Qt
from PyQt6.QtGui import QFont, QFontDatabase, QImage
from PyQt6.QtWidgets import QApplication, QMessageBox, QTabBar, QWidget
from pytestqt.qtbot import QtBot

from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.gui.panels.panel import Panel
from app.gui.shell.main_window import MainWindow
from app.measurement.averages import FRAMES
from app.results.player import InstrumentFactory
from reconstruction.arrays import Floats
from support.gui_bench import BENCH, SENSOR, FakeCamera, opener
from support.patience import HANG_S

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

MakeWindow = Callable[..., MainWindow]


class PatientBot(QtBot):
    """Waits long enough for a slow computer."""

    def waitUntil(self, callback: Callable[[], bool | None], *, timeout: int = int(1000 * HANG_S)) -> None:  # noqa: N802 - Qt's
        super().waitUntil(callback, timeout=timeout)


LENSLETS = SENSOR.lenslets


def use_font(application: QApplication) -> None:
    """Use the font that Matplotlib ships, in the default size."""
    files = Path(mpl.get_data_path()) / "fonts" / "ttf"
    family = "DejaVu Sans"
    for name in ("DejaVuSans.ttf", "DejaVuSans-Bold.ttf"):
        number = QFontDatabase.addApplicationFont(str(files / name))
        assert family in QFontDatabase.applicationFontFamilies(number)
    font = QFont(application.font())
    font.setFamily(family)
    application.setFont(font)


@contextmanager
def windows() -> Iterator[MakeWindow]:
    """Yield a function that makes windows, and close them afterwards."""
    made: list[MainWindow] = []

    def make(
        *cameras: FakeCamera, saved: QSettings | None = None, resized: bool = True, frames: int = FRAMES
    ) -> MainWindow:
        spare, begin = iter(cameras), partial(start_up, frames=frames)
        window = MainWindow(saved=saved)
        window.controller.access = InstrumentFactory(lambda: Acquisition(BENCH, opener(next(spare))), begin)
        if resized:
            window.resize(1000, 760)
        window.show()
        made.append(window)
        return window

    yield make
    for window in made:
        window.close()
        window.deleteLater()


def wait_for_wavefront(qtbot: QtBot, window: MainWindow) -> None:
    qtbot.waitUntil(lambda: window.verdict.valid == "117 of 117")
    qtbot.waitUntil(lambda: window.controller.is_settled)


def count_pixels(qtbot: QtBot, window: MainWindow) -> None:
    """Wait until the pixels of the shown frame are counted and measured, and show the numbers."""
    panel = window.panels.camera
    analysis = window.analyses.of[panel]
    counts = [window.shown.statistics]

    def are_counted() -> bool:
        if window.shown.statistics is not counts[-1]:
            counts.append(window.shown.statistics)
        last, now = analysis.request, panel.request()
        is_newest = last is not None and now is not None and last.of is now.of and last.choice == now.choice
        # While frames come quickly the newest is never counted: the second result was requested after this call.
        return (is_newest and not analysis.is_busy) or len(counts) > 2

    qtbot.waitUntil(are_counted)
    window.update_text()


def acquisition_of(window: MainWindow) -> Acquisition:
    """Return the acquisition of a window that runs it in this process."""
    assert isinstance(window.controller.acquisition, Acquisition)
    return window.controller.acquisition


def press(qtbot: QtBot, widget: QWidget, key: Qt.Key) -> None:
    qtbot.keyClick(widget, key)  # type: ignore[no-untyped-call] # pytest-qt declares no types for it


def click(qtbot: QtBot, widget: QWidget, at: QPoint) -> None:
    qtbot.mouseClick(widget, Qt.MouseButton.LeftButton, pos=at)  # type: ignore[no-untyped-call] # pytest-qt again


def said_in(window: MainWindow) -> str:
    """Return the text of the message strip, in small letters."""
    return window.messages.text.text().lower()


def choose_button(monkeypatch: pytest.MonkeyPatch, label: str, defaults: list[str] | None = None) -> list[str]:
    """Click a button of the next message box; returns the questions asked, and into `defaults` what Return answers."""
    asked: list[str] = []

    def click(box: QMessageBox) -> int:
        asked.append(f"{box.text()} {box.informativeText()}")
        if defaults is not None and (button := box.defaultButton()) is not None:
            defaults.append(button.text().replace("&", ""))
        next(each for each in box.buttons() if each.text().replace("&", "") == label).click()
        return 0

    monkeypatch.setattr(QMessageBox, "exec", click)
    return asked


def tabs(window: MainWindow) -> dict[str, Panel]:
    """Panels that are tabs, by title."""
    return {panel.title: panel for panel in window.panels if panel.is_tab}


def tab(window: MainWindow, title: str) -> tuple[QTabBar, QPoint]:
    """Find a panel's tab: its bar, and its middle there."""
    QApplication.processEvents()
    bars = [bar for bar in window.findChildren(QTabBar) if bar.isVisible()]  # Qt keeps others
    places = [(bar, index) for bar in bars for index in range(bar.count()) if bar.tabText(index) == title]
    (bar, index) = places[0]
    return bar, bar.tabRect(index).center()


def picture(widget: QWidget) -> NDArray[np.uint8]:
    """Grab a widget, (row, column, rgb)."""
    image = widget.grab().toImage().convertToFormat(QImage.Format.Format_RGB888)
    data = image.constBits()
    assert data is not None
    lines = np.frombuffer(bytes(data.asarray(image.sizeInBytes())), np.uint8).reshape(image.height(), -1)
    return lines[:, : 3 * image.width()].reshape(image.height(), image.width(), 3)


def part(seen: NDArray[np.uint8], where: QRect) -> NDArray[np.uint8]:
    return seen[where.top() : where.bottom() + 1, where.left() : where.right() + 1]


def views(seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(0, 2, (3, 3, *LENSLETS))


def dim_frame() -> NDArray[np.uint16]:
    return np.full((300, 430), 1000, np.uint16)
