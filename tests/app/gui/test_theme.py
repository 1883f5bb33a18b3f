"""Theme: texts are legible in the light and in the dark."""

from __future__ import annotations

import numpy as np
import pytest
from PyQt6.QtCore import QObject, Qt, pyqtSignal
from PyQt6.QtGui import QColor, QPalette
from PyQt6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import picture, tabs

from app.gui.shell.main_window import MainWindow
from app.gui.widgets import theme
from app.gui.widgets.enlarged_view import CONTOUR
from app.gui.widgets.presentation import colour_table, diverging


class Desktop(QObject):
    """The hints of a desktop whose colours change."""

    colorSchemeChanged = pyqtSignal(Qt.ColorScheme)  # noqa: N815 - Qt's name

    def __init__(self) -> None:
        super().__init__()
        self.scheme = Qt.ColorScheme.Dark

    def colorScheme(self) -> Qt.ColorScheme:  # noqa: N802 - Qt's name
        return self.scheme

    def change(self, scheme: Qt.ColorScheme) -> None:
        self.scheme = scheme
        self.colorSchemeChanged.emit(scheme)


@pytest.fixture
def desktop(qapp: QApplication, monkeypatch: pytest.MonkeyPatch) -> Desktop:
    made = Desktop()
    monkeypatch.setattr(qapp, "styleHints", lambda: made, raising=False)
    return made


def luminance(colour: QColor) -> float:
    """Relative luminance of WCAG 2.1."""
    channels = [value or 0.0 for value in colour.getRgbF()[:3]]
    linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.usefixtures("restored_theme")
@pytest.mark.parametrize("scheme", [Qt.ColorScheme.Dark, Qt.ColorScheme.Light, Qt.ColorScheme.Unknown])
def test_theme_follows_the_desktop_and_is_legible(qapp: QApplication, desktop: Desktop, scheme: Qt.ColorScheme) -> None:
    desktop.scheme = scheme
    theme.styled_application()
    ground = qapp.palette().color(QPalette.ColorRole.Window)
    assert (luminance(ground) > 0.5) == (scheme is Qt.ColorScheme.Light)
    assert theme.TEXT.name() in qapp.styleSheet()
    for text in (theme.TEXT, theme.DIM, theme.ACCENT, theme.GREEN, theme.AMBER, theme.RED):
        for behind in (theme.BACKGROUND, theme.SURFACE):
            darker, lighter = sorted((luminance(text), luminance(behind)))
            assert (lighter + 0.05) / (darker + 0.05) >= 4.5, (text.name(), behind.name())


def contrast(one: QColor, other: QColor) -> float:
    """Contrast of WCAG 2.1."""
    darker, lighter = sorted((luminance(one), luminance(other)))
    return (lighter + 0.05) / (darker + 0.05)


@pytest.mark.usefixtures("restored_theme")
@pytest.mark.parametrize("name", ["dark", "light"])
def test_lines_maps_and_arrows_have_contrast(qapp: QApplication, name: str) -> None:
    theme.styled_application()
    theme.use_theme(qapp, name)
    grounds = theme.BACKGROUND, theme.SURFACE
    texts = theme.TEXT, theme.DIM, theme.ACCENT, theme.GREEN, theme.AMBER, theme.RED
    assert min(contrast(text, ground) for text in texts for ground in grounds) >= 4.5
    assert min(contrast(text, theme.RAISED) for text in texts) >= 4.5  # on buttons and choices
    assert contrast(theme.LINE, theme.RAISED) >= 3  # the hatching of unknown values
    assert contrast(theme.TEXT, theme.CHECKED) >= 4.5
    assert contrast(theme.BACKGROUND, theme.AMBER) >= 4.5  # a badge
    lines = theme.LINE, theme.ACCENT, theme.GREEN, theme.AMBER, theme.RED
    assert min(contrast(line, ground) for line in lines for ground in grounds) >= 3
    assert contrast(theme.LIT, theme.CHECKED) >= 3  # the lamp on its button
    colours = [QColor.fromRgb(int(colour)) for colour in colour_table(diverging(1.0, "rad").colours)]
    zero = colours[len(colours) // 2]
    assert luminance(zero) > 0.7
    assert min(contrast(end, zero) for end in (colours[0], colours[-1])) >= 4.5
    assert max(contrast(zero, ground) for ground in (theme.BACKGROUND, theme.LINE)) >= 3  # LINE is around each map
    assert min(contrast(colour, CONTOUR) for colour in colours) >= 3
    black, white = QColor("black"), QColor("white")
    for drawn in (theme.ACCENT_ON_IMAGE, theme.GREEN_ON_IMAGE, theme.AMBER_ON_IMAGE, theme.RED_ON_IMAGE):
        assert contrast(drawn, black) >= 3
    assert contrast(black, white) >= 3  # the edge of an arrow over a bright spot
    of_lines = blend(theme.ACCENT_ON_IMAGE, black, 150 / 255)
    assert contrast(of_lines, black) >= 3  # the lattice


def blend(colour: QColor, ground: QColor, share: float) -> QColor:
    pairs = zip(colour.getRgb()[:3], ground.getRgb()[:3], strict=True)
    return QColor(*(round(share * (one or 0) + (1 - share) * (other or 0)) for one, other in pairs))


def share(window: QWidget, colour: str) -> int:
    """Number of pixels of a colour."""
    wanted = QColor(colour)
    return int((picture(window) == np.array([wanted.red(), wanted.green(), wanted.blue()])).all(axis=2).sum())


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("restored_theme")
def test_open_window_follows_the_desktop(desktop: Desktop, live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    theme.styled_application()
    for panel in tabs(window).values():
        panel.front_requested.emit()
        QApplication.processEvents()
    window.panels.quality.front_requested.emit()
    dark = {id(colour): colour.name() for colour, _, _ in theme._PAIRS}
    qtbot.waitUntil(lambda: share(window.panels.quality, theme.AMBER.name()) > 0)
    assert share(window, theme.BACKGROUND.name()) > 1e5
    desktop.change(Qt.ColorScheme.Light)
    for panel in (*tabs(window).values(), window.panels.camera, window.panels.wavefronts):
        panel.front_requested.emit()
        qtbot.waitUntil(lambda panel=panel: share(panel, theme.BACKGROUND.name()) > 3000)  # type: ignore[misc] # mypy and defaults
        assert theme.BACKGROUND.name() == "#eef0f3"
        for colour in (theme.BACKGROUND, theme.SURFACE, theme.LINE):
            assert share(panel, dark[id(colour)]) < 30, (type(panel).__name__, dark[id(colour)])
    window.panels.quality.front_requested.emit()
    qtbot.waitUntil(lambda: share(window.panels.quality, theme.AMBER.name()) > 0)
    assert share(window.panels.quality, dark[id(theme.AMBER)]) == 0
    qtbot.waitUntil(lambda: share(window.controls, theme.GREEN.name()) > 20)  # the lamps
    assert share(window.controls, dark[id(theme.GREEN)]) == 0
    desktop.change(Qt.ColorScheme.Dark)
    qtbot.waitUntil(lambda: share(window, dark[id(theme.BACKGROUND)]) > 1e5)
