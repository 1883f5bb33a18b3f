"""The help menu: keys, message log, documentation, citation and versions."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

import pytest
from PyQt6.QtCore import Qt, QUrl
from PyQt6.QtGui import QAction
from PyQt6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.paths import DOCS, ROOT
from support.window_tools import MakeWindow, press

from app.documentation import documentation
from app.gui.shell.help import TextDialog
from app.gui.shell.main_window import MainWindow


def choose(window: MainWindow, entry: str) -> None:
    """Choose an entry of a menu."""
    (action,) = (each for each in window.findChildren(QAction) if each.text() == entry)
    action.trigger()


def opened(window: MainWindow, name: str) -> TextDialog:
    dialog = window.findChild(TextDialog, name)
    assert dialog is not None
    assert dialog.isVisible()
    return dialog


def test_log_keeps_notices_with_their_times(make_window: MakeWindow, tmp_path: Path) -> None:
    window = make_window()
    window.recording_bar.use_folder(tmp_path)
    window.messages.warn("it is Monday")
    window.messages.warn("it is Monday")
    choose(window, "Message log…")
    dialog = opened(window, "log")
    first, second = dialog.view.toPlainText().splitlines()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d  Recordings are saved in .*", first)
    assert second.endswith("  It is Monday")
    window.messages.show_state(failure="", warning="dark is stale", advice="")
    window.messages.show_state(failure="", warning="dark is stale", advice="")
    assert dialog.view.toPlainText().count("Dark is stale") == 1  # at once, not at every refresh
    for share in ("1.5", "12", "13"):
        window.messages.show_state(failure="", warning=f"{share} % stray light", advice="")
    assert dialog.view.toPlainText().count("stray light") == 1  # its number alone has changed
    dialog.copy.click()
    clipboard = QApplication.clipboard()
    assert clipboard is not None
    assert clipboard.text() == window.messages.log == dialog.view.toPlainText()
    dialog.close()
    window.messages.inform("closed")  # must not reach the deleted dialog


def test_empty_log_repeats_the_sentence_of_the_strip(make_window: MakeWindow) -> None:
    window = make_window()
    choose(window, "Message log…")
    sentence = window.messages.text.text()
    assert "Ctrl+O" in sentence
    assert opened(window, "log").view.toPlainText() == f"No message so far. Shown now: {sentence}"


def test_log_tells_what_failed(make_window: MakeWindow, qtbot: QtBot) -> None:
    camera = FakeCamera()
    camera.fault = RuntimeError("smoke")
    window = make_window(camera)
    window.messages.show_state(failure="the camera was unplugged", warning="", advice="F1")
    qtbot.waitUntil(lambda: "The camera was unplugged" in window.messages.log)
    assert "F1" not in window.messages.log


def test_documentation_opens_and_its_links_lead_on(make_window: MakeWindow) -> None:
    window = make_window()
    choose(window, "Documentation…")
    dialog = opened(window, "documentation")
    assert dialog.view.toPlainText().startswith("svwfs")
    assert not dialog.back.isEnabled()
    bar = dialog.view.horizontalScrollBar()
    assert bar is not None
    for _ in range(5):
        QApplication.processEvents()
    assert bar.maximum() == 0  # no picture is cut
    dialog.view.setSource(QUrl("first_measurement.md"))  # as a click on the link
    assert "measurement" in dialog.view.toPlainText().splitlines()[0]
    dialog.back.click()
    assert dialog.view.toPlainText().startswith("svwfs")


def test_question_mark_opens_the_entry_of_the_shown_message(make_window: MakeWindow) -> None:
    window = make_window()
    strip = window.messages
    strip.alarm("the camera protects its EM register from too much light and sends black frames")
    strip.show_state(failure="", warning="", advice="")
    assert strip.explain.isVisible()
    strip.explain.click()
    dialog = opened(window, "documentation")
    assert dialog.view.textCursor().selectedText() == "EM register protected"
    assert dialog.view.cursorRect().top() < dialog.view.height() / 4
    strip.alarm("nothing of the kind")
    strip.show_state(failure="", warning="", advice="")
    assert not strip.explain.isVisible()


def test_every_page_can_be_reached_and_no_link_leaves_the_documentation() -> None:
    linked, found = [DOCS / "index.md"], set[Path]()
    while linked:
        page = linked.pop()
        found.add(page)
        for link in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text("utf-8")):
            target = (page.parent / link).resolve()
            assert target.is_file(), f"{page.name}: {link}"
            assert target.is_relative_to(DOCS), f"{page.name}: {link}"
            if target.suffix == ".md" and target not in found:
                linked.append(target)
    assert found == set(DOCS.rglob("*.md"))


def test_window_page_has_every_key(make_window: MakeWindow) -> None:
    window = make_window()
    text = (DOCS / "window.md").read_text("utf-8").partition("## Keys")[2]
    listed = set(re.findall(r"(?<![\w+])(?:Ctrl\+|Shift\+)*(?:F\d+|Esc|Space|[A-Z0-9]|,|\.)(?![\w])", text))
    keys = {key for entries in window._menus().values() for _, key, _ in filter(None, entries) if key}
    assert not keys - listed


def test_missing_documentation_is_reported(make_window: MakeWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.__file__", "/nowhere/app/__init__.py")
    assert documentation() is None
    window = make_window()
    choose(window, "Documentation…")
    assert "documentation is not installed" in window.messages.log


def test_citation_agrees_with_the_citation_file(make_window: MakeWindow) -> None:
    window = make_window()
    choose(window, "About svwfs…")
    text = opened(window, "about").view.toPlainText()
    file = (ROOT / "CITATION.cff").read_text("utf-8")
    for key in ("title: Space-variant", "doi: ", "journal: "):
        value = next(line.partition(": ")[2] for line in file.splitlines() if line.strip().startswith(key))
        assert value in text.replace("{Shack-Hartmann}", "Shack-Hartmann")
    authors = re.findall(r"given-names: (\w+), family-names: (\w+)", file)
    assert [family for _, family in authors] == re.findall(
        r"[A-Z]\. (\w+)", text[text.index("The method:") :].splitlines()[2]
    )
    assert f"version: {version('svwfs')}" in file


def test_about_names_version_and_libraries(make_window: MakeWindow) -> None:
    window = make_window()
    choose(window, "About svwfs…")
    text = opened(window, "about").view.toPlainText()
    assert f"Version: {version('svwfs')}" in text
    assert f"numpy: {version('numpy')}" in text


def test_escape_closes_only_the_list_of_keys(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    choose(window, "Shortcuts and conventions…")
    dialog = opened(window, "help")
    for words in ("Take a dark", "Edit the exposure", "Uncertainty over the field"):
        assert words in dialog.view.toPlainText().replace("\N{NO-BREAK SPACE}", " ")
    press(qtbot, dialog, Qt.Key.Key_Escape)
    assert not dialog.isVisible()
    assert window.isVisible()
