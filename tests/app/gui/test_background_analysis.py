"""The analysis thread: computes only what is requested, and nothing twice."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from typing import Any

import numpy as np
import pytest
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH
from support.patience import HANG_S
from support.wavefronts import bowl

from app.gui.panels.panel import Panel, Request, Shown
from app.gui.shell.analyses import AnalysisThread
from app.results.view_analysis import Quantity, quantity_maps


@pytest.fixture
def panel(qtbot: QtBot) -> Panel:
    made = Panel(Shown())
    qtbot.addWidget(made)
    return made


@pytest.fixture
def thread() -> Iterator[AnalysisThread]:
    made = AnalysisThread(lambda: None)
    yield made
    made.close()


def request(quantity: Quantity) -> Request:
    wavefront = bowl()
    return Request(wavefront, quantity, lambda _: quantity_maps(wavefront, quantity, BENCH.reconstruction))


def made(of: object, compute: Callable[[], Any], *, choice: object = None, interval_s: float = 0.0) -> Request:
    return Request(of, choice, lambda _: compute(), interval_s)


def wait(thread: AnalysisThread) -> tuple[Panel, Request, Future[Any]]:
    deadline_s = time.monotonic() + HANG_S
    while time.monotonic() < deadline_s:
        if results := thread.take():
            (result,) = results
            return result
        time.sleep(0.005)
    raise TimeoutError


def test_repeated_request_is_ignored_and_new_wavefront_waits(thread: AnalysisThread, panel: Panel) -> None:
    first = request(Quantity.PSF)
    began_s = time.monotonic()  # the second waits from here, however long the first takes
    thread.submit({panel: first})
    assert wait(thread)[:2] == (panel, first)
    thread.submit({panel: first})
    assert not thread.is_busy
    while not thread.is_busy:
        thread.submit({panel: request(Quantity.PSF)})
    assert time.monotonic() - began_s > 0.1
    wait(thread)
    thread.submit({panel: request(Quantity.DIFFERENCE)})  # a choice of the user is analysed immediately
    assert thread.is_busy


def test_error_of_analysis_is_returned_and_thread_continues(thread: AnalysisThread, panel: Panel) -> None:
    def fail() -> None:
        raise NotImplementedError("broken")

    thread.submit({panel: made(1, fail)})
    *_, result = wait(thread)
    assert isinstance(result.exception(), NotImplementedError)
    thread.submit({panel: request(Quantity.PSF)})
    *_, result = wait(thread)
    assert result.result() is not None


def test_error_of_one_panel_leaves_the_others_their_results(thread: AnalysisThread, qtbot: QtBot) -> None:
    panels = [Panel(Shown()) for _ in range(3)]
    for each in panels:
        qtbot.addWidget(each)
    thread.submit({each: made(0, partial(divmod, 7, index)) for index, each in enumerate(panels)})
    deadline_s = time.monotonic() + HANG_S
    while not (results := thread.take()) and time.monotonic() < deadline_s:
        time.sleep(0.005)
    failed, *others = [future for _, _, future in results]
    assert isinstance(failed.exception(), ZeroDivisionError)
    assert [future.result() for future in others] == [(7, 0), (3, 1)]


def test_slow_analysis_leaves_the_measurement_most_of_a_core(thread: AnalysisThread, panel: Panel) -> None:
    requested_s: list[float] = []
    number = 0
    while len(requested_s) < 5:
        number += 1
        thread.submit({panel: made(number, partial(time.sleep, 0.05))})
        thread.take()
        if thread._requested_s not in requested_s:
            requested_s.append(thread._requested_s)
        time.sleep(0.002)
    assert np.diff(requested_s).min() >= 4.9 * 0.05
