"""Threads and windows that outlive their test."""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager

_END_S = 30.0  # for threads that are about to end, at low priority beside other tests
_LASTING = ("zarr_io", "asyncio_", "reconstruction_")  # Zarr's, and those of `worker_pool`, last as long as the process


@contextmanager
def no_leftovers() -> Iterator[None]:
    """Fail if a thread that was started within, or a top-level widget, is left at the end."""
    before = set(threading.enumerate())
    yield
    widgets, threads = left_widgets(), left_threads(before)
    assert not widgets, f"windows outlive the test: {widgets}"
    assert not threads, f"threads outlive the test: {threads}"


def left_threads(before: Collection[threading.Thread]) -> list[str]:
    """Names of the threads that were not there before and do not end soon."""
    deadline_s = time.monotonic() + _END_S
    started = [each for each in threading.enumerate() if each not in before and not _lasts(each)]
    for thread in started:
        thread.join(max(0.0, deadline_s - time.monotonic()))
    return [thread.name for thread in started if thread.is_alive()]


def left_widgets() -> list[str]:
    """Top-level widgets; those without an owner are freed first."""
    if "PyQt6.QtWidgets" not in sys.modules:  # only tests of the window load Qt
        return []
    from PyQt6.QtCore import QEvent  # noqa: PLC0415 - it is loaded
    from PyQt6.QtWidgets import QApplication  # noqa: PLC0415 - it is loaded

    if QApplication.instance() is None or not QApplication.topLevelWidgets():
        return []
    QApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)
    gc.collect()
    return [f"{type(each).__name__} {each.windowTitle()}".strip() for each in QApplication.topLevelWidgets()]


def _lasts(thread: threading.Thread) -> bool:
    """True for threads that last as long as the process, and for those that Python has not started and cannot join."""
    return isinstance(thread, threading._DummyThread) or thread.name.startswith(_LASTING)
