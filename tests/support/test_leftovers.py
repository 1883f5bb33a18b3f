"""Threads and windows that outlive a test are found."""

from __future__ import annotations

import threading
import time

import pytest
from PyQt6.QtWidgets import QApplication, QLabel

from support import leftovers
from support.leftovers import left_widgets, no_leftovers


def test_thread_that_does_not_end_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leftovers, "_END_S", 0.05)
    ends = threading.Event()
    with pytest.raises(AssertionError, match=r"threads outlive the test: .*endless"), no_leftovers():
        threading.Thread(target=ends.wait, name="endless").start()
    ends.set()


def test_thread_that_ends_soon_is_none_and_earlier_ones_stay() -> None:
    ends = threading.Event()
    thread = threading.Thread(target=ends.wait)
    thread.start()
    with no_leftovers():
        threading.Thread(target=time.sleep, args=(0.1,)).start()
    assert thread.is_alive()
    ends.set()


def test_window_is_found_until_nobody_owns_it(qapp: QApplication) -> None:
    assert qapp.applicationName() is not None
    window = QLabel()
    window.setWindowTitle("svwfs")
    with pytest.raises(AssertionError, match=r"windows outlive the test: .*QLabel svwfs"), no_leftovers():
        pass
    del window
    assert left_widgets() == []
