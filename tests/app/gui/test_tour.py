"""The tour of the window, and its splash."""

from __future__ import annotations

import subprocess
import sys

import pytest
from PyQt6.QtCore import QPoint, Qt
from PyQt6.QtGui import QWindow
from PyQt6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot
from support.patience import own_time
from support.window_tools import MakeWindow, press

from app.gui.shell.help import Tour
from app.gui.shell.main_window import MainWindow
from app.gui.splash import Splash
from app.gui.widgets.theme import apply_theme


def begun(make_window: MakeWindow) -> tuple[MainWindow, Tour]:
    window = make_window()
    window.activateWindow()
    window.setFocus()
    window.show_tour()
    made = window.findChild(Tour)
    assert made is not None
    QApplication.processEvents()
    return window, made


@pytest.fixture
def tour(make_window: MakeWindow) -> tuple[MainWindow, Tour]:
    return begun(make_window)


def place(widget: QWidget) -> QPoint:
    return widget.mapToGlobal(QPoint())


@pytest.fixture(params=["bare", "theme"])
def look(request: pytest.FixtureRequest, qapp: QApplication, restored_theme: None) -> None:  # noqa: ARG001 - restores
    if request.param == "theme":
        apply_theme(qapp)


@pytest.mark.usefixtures("look")
def test_button_stays_in_place_while_the_parts_are_outlined(make_window: MakeWindow) -> None:
    window, bubble = begun(make_window)
    at, outlined = place(bubble.next), list[QWidget]()
    panels = (window.panels.camera, window.panels.wavefronts, window.controls)
    for part in (*panels, window.messages, window.recording_panel):
        QApplication.processEvents()
        assert place(bubble.next) == at
        assert bubble._outline.size() == part.size()
        assert place(bubble._outline) == place(part)
        assert bubble.text.height() >= bubble.text.heightForWidth(bubble.text.width())  # no text is cut
        outlined.append(part)
        bubble.next.click()
    assert not bubble.isVisible()
    assert not bubble._outline.isVisible()
    assert len(outlined) == 5


def test_escape_ends_the_tour_and_nothing_else(tour: tuple[MainWindow, Tour], qtbot: QtBot) -> None:
    window, bubble = tour
    cancelled: list[bool] = []
    window.messages.cancel_requested.connect(lambda: cancelled.append(True))
    press(qtbot, window, Qt.Key.Key_Escape)
    assert not bubble.isVisible()
    assert not cancelled
    press(qtbot, window, Qt.Key.Key_Escape)
    assert cancelled


def test_no_panel_lies_over_the_bubble(tour: tuple[MainWindow, Tour], qtbot: QtBot) -> None:
    window, bubble = tour
    window.panels.lenslet.inspect(3, 3)
    lenslet, corner = window.panels.lenslet, bubble.mapTo(window, QPoint(8, bubble.height() - 8))
    qtbot.waitUntil(lambda: lenslet.isVisible() and not window.unpainted)
    assert lenslet.rect().contains(lenslet.mapFrom(window, corner))
    qtbot.waitUntil(lambda: window.childAt(corner) in {bubble, *bubble.findChildren(QWidget)})


def test_splash_gives_way_to_the_window(qtbot: QtBot) -> None:
    splash = Splash()
    assert "svwfs" in splash.message()
    assert not splash.isVisible()  # offscreen
    window = QWidget()
    qtbot.addWidget(window)
    window.show()
    splash.show()
    splash.finish(window)
    assert not splash.isVisible()


@pytest.mark.parametrize("is_slow", [False, True])
def test_splash_waits_until_the_x_server_shows_it(
    qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, *, is_slow: bool
) -> None:
    asked: list[None] = []

    def is_exposed(_: QWindow) -> bool:
        asked.append(None)
        return not is_slow and len(asked) > 3

    monkeypatch.setattr(QWindow, "isExposed", is_exposed)
    monkeypatch.setattr(QApplication, "platformName", lambda: "xcb")
    with own_time() as elapsed_s:
        splash = Splash()
        assert elapsed_s() < 10  # also if it never does
    qtbot.addWidget(splash)
    assert splash.isVisible()
    assert len(asked) > 3


def test_splash_is_the_first_widget_of_a_program() -> None:
    """It makes the application, which lives as long as it does."""
    program = "from app.gui.splash import Splash; splash = Splash(); splash.hide(); print(splash.message())"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert (ended.returncode, ended.stdout.strip()) == (0, "svwfs is starting ..."), ended.stderr
