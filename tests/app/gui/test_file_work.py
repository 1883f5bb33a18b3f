"""File work on threads, with a disk that does not answer."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial

import pytest
from PyQt6.QtCore import QObject
from pytestqt.qtbot import QtBot

from app.errors import RunError
from app.gui.widgets.file_work import FileWork, answer


@pytest.fixture
def disk() -> Iterator[threading.Event]:
    """A disk that answers as soon as the event is set."""
    event = threading.Event()
    yield event
    event.set()


def test_work_is_done_in_order_while_events_go_on(qtbot: QtBot, disk: threading.Event) -> None:
    parent, results, warned = QObject(), list[str](), list[str]()
    work = FileWork(parent, warned.append)

    def refuse() -> str:
        raise RunError("the disk is full")

    work.run(lambda: f"first {disk.wait()}", results.append)
    work.run(refuse, results.append)
    work.run(lambda: "third", results.append)
    qtbot.wait(100)
    assert not results
    disk.set()
    qtbot.waitUntil(lambda: results == ["first True", "third"])
    assert warned == ["the disk is full"]


def _late_result(name: str, disk: threading.Event) -> str:
    return f"{name} {disk.wait(0.1)}"


def test_close_waits_for_what_is_written(qtbot: QtBot, disk: threading.Event) -> None:
    parent, results = QObject(), list[str]()
    writing, reading = (FileWork(parent, results.append) for _ in range(2))
    reading.run(lambda: f"read {disk.wait()}", results.append)
    for name in ("one", "two"):
        writing.run(partial(_late_result, name, disk), results.append, writes=name)
    assert not reading.close()  # at once
    assert not writing.close()
    assert results == ["one False", "two False"]
    disk.set()
    qtbot.wait(100)
    assert results == ["one False", "two False"]


def test_close_tells_what_was_not_written(disk: threading.Event, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.gui.widgets.file_work._CLOSING_S", 0.05)
    parent, results = QObject(), list[str]()
    work = FileWork(parent, results.append)

    def refuse() -> str:
        raise RunError("the disk is full")

    work.run(refuse, results.append, writes="one")
    work.run(lambda: f"two {disk.wait()}", lambda _: work.run(refuse, results.append), writes="two")
    work.run(lambda: "read", results.append)
    work.run(lambda: "three", results.append, writes="three")
    late = "not saved: the disk has not answered when the window was closed"
    assert work.close() == ["the disk is full", f"two: {late}", f"three: {late}"]
    work.run(lambda: "after the end", results.append)
    assert not work.is_busy
    assert not results  # nobody sees them


def test_question_without_answer_has_the_other_one(disk: threading.Event) -> None:
    assert answer(disk.wait, otherwise=False) is False
    disk.set()
    assert answer(disk.wait, otherwise=False) is True
