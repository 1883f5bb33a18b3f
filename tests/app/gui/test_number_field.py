"""Fields for numbers: what is typed is understood in any notation, or refused and not sent."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from PyQt6.QtCore import QLocale, Qt
from pytestqt.qtbot import QtBot
from support.window_tools import press

from app.gui.widgets import theme
from app.gui.widgets.fields import NumberField
from drivers.interface import Range


def type_text(qtbot: QtBot, field: NumberField, text: str) -> None:
    qtbot.keyClicks(field, text)  # type: ignore[no-untyped-call] # pytest-qt declares no types for it


@pytest.fixture
def language(request: pytest.FixtureRequest) -> Iterator[None]:
    before = QLocale()
    QLocale.setDefault(QLocale(request.param))
    yield
    QLocale.setDefault(before)


@pytest.fixture
def current(qtbot: QtBot) -> Iterator[NumberField]:
    """A field for 0 ... 1 A that shows 350 mA, edited as in the window."""
    field = NumberField(name="Current", unit="mA", decimals=1, tool_tip="")
    field.show_value(0.35, Range(0, 1))
    field.show()
    field.activateWindow()
    field.edit()
    qtbot.waitUntil(field.hasFocus)
    yield field
    field.deleteLater()


@pytest.mark.parametrize("language", ["en_US", "de_DE"], indirect=True)
@pytest.mark.usefixtures("language")
@pytest.mark.parametrize(
    ("typed", "current_a"),
    [
        ("27,5", 0.0275),
        ("27.5", 0.0275),
        ("27,5 mA", 0.0275),
        ("0.65 A", 0.65),
        ("0,45A", 0.45),
        ("450 mA", 0.45),
        ("2.5e2", 0.25),
        ("500 uA", 0.0005),
        ("1000", 1.0),
    ],
)
def test_number_is_understood_in_any_notation(current: NumberField, qtbot: QtBot, typed: str, current_a: float) -> None:
    sent = list[float]()
    current.entered.connect(sent.append)
    type_text(qtbot, current, typed)
    assert not current.styleSheet()
    press(qtbot, current, Qt.Key.Key_Return)
    assert sent == [pytest.approx(current_a)]
    assert current.text() == f"{1000 * current_a:.1f}"  # a point in every language
    assert not current.hasFocus()


@pytest.mark.parametrize("typed", ["9999", "1000.1", "1,001 A", "-1", "1,000.5", "350 ms", "350 kA", "abc", ""])
@pytest.mark.parametrize("end", [Qt.Key.Key_Return, Qt.Key.Key_Tab])
def test_impossible_number_is_refused_in_red_and_not_sent(
    current: NumberField, qtbot: QtBot, typed: str, end: Qt.Key
) -> None:
    sent, refused = list[float](), list[str]()
    current.entered.connect(sent.append)
    current.refused.connect(refused.append)
    press(qtbot, current, Qt.Key.Key_Backspace)
    type_text(qtbot, current, typed)
    assert theme.RED.name() in current.styleSheet()
    if end == Qt.Key.Key_Return:
        press(qtbot, current, end)
        assert current.hasFocus()  # to be corrected
        press(qtbot, current, Qt.Key.Key_Escape)
    else:
        current.clearFocus()
    said = [why for why in refused if why][-1]
    assert said.startswith(f"Current {typed}".strip())
    assert "0 ... 1000 mA" in said
    assert (refused[-1] == said) == (end == Qt.Key.Key_Tab)  # Esc needs no explanation
    assert not current.hasFocus()
    assert current.text() == "350.0"
    assert not current.styleSheet()
    assert not sent


@pytest.mark.parametrize("typed", ["1e999", "-1e999"])
def test_infinite_whole_number_is_refused(qtbot: QtBot, typed: str) -> None:
    field, refused = NumberField(name="Frames", tool_tip=""), list[str]()
    qtbot.addWidget(field)
    field.show_value(20, Range(1, 1000))
    field.refused.connect(refused.append)
    field.edit()
    type_text(qtbot, field, typed)
    press(qtbot, field, Qt.Key.Key_Return)
    assert refused[-1].startswith(f"Frames {typed}: type a number")
    assert field.value() == 20
