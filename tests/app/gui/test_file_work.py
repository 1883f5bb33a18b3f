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
    writing, reading = (FileWork(parent, results.append, is_writing=is_writing) for is_writing in (True, False))
    reading.run(lambda: f"read {disk.wait()}", results.append)
    for name in ("one", "two"):
        writing.run(partial(_late_result, name, disk), results.append)
    reading.close()  # at once
    writing.close()
    assert results == ["one False", "two False"]
    disk.set()
    qtbot.wait(100)
    assert results == ["one False", "two False"]


def test_question_without_answer_has_the_other_one(disk: threading.Event) -> None:
    assert answer(disk.wait, otherwise=False) is False
    disk.set()
    assert answer(disk.wait, otherwise=False) is True
