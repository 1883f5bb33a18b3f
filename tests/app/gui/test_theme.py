"""Theme: texts are legible in the light and in the dark."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor, QPalette
from PyQt6.QtWidgets import QApplication

from app.gui import theme


@pytest.fixture
def restored(qapp: QApplication) -> Iterator[None]:
    colours = [(colour, colour.name()) for colour, _ in theme._LIGHT]
    palette, style = qapp.palette(), qapp.styleSheet()
    yield
    for colour, name in colours:
        colour.setNamedColor(name)
    qapp.setPalette(palette)
    qapp.setStyleSheet(style)


def luminance(colour: QColor) -> float:
    """Relative luminance of WCAG 2.1."""
    channels = [value or 0.0 for value in colour.getRgbF()[:3]]
    linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.usefixtures("restored")
@pytest.mark.parametrize("scheme", [Qt.ColorScheme.Dark, Qt.ColorScheme.Light, Qt.ColorScheme.Unknown])
def test_theme_follows_the_desktop_and_is_legible(
    qapp: QApplication, monkeypatch: pytest.MonkeyPatch, scheme: Qt.ColorScheme
) -> None:
    monkeypatch.setattr(qapp, "styleHints", lambda: SimpleNamespace(colorScheme=lambda: scheme), raising=False)
    theme.apply_theme(qapp)
    ground = qapp.palette().color(QPalette.ColorRole.Window)
    assert (luminance(ground) > 0.5) == (scheme is Qt.ColorScheme.Light)
    assert theme.TEXT.name() in qapp.styleSheet()
    for text in (theme.TEXT, theme.DIM, theme.ACCENT, theme.GREEN, theme.AMBER, theme.RED):
        for behind in (theme.BACKGROUND, theme.SURFACE):
            darker, lighter = sorted((luminance(text), luminance(behind)))
            assert (lighter + 0.05) / (darker + 0.05) >= 4.5, (text.name(), behind.name())
