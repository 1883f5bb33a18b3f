"""The analysis thread: computes only what is requested, and nothing twice."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from typing import Any

import numpy as np
import pytest
from support.gui_bench import BENCH
from support.patience import HANG_S
from support.wavefronts import bowl

from app.gui.panels.panel import Request
from app.gui.shell.analyses import Analysis
from app.results.view_maps import Quantity, quantity_maps


@pytest.fixture
def analysis() -> Iterator[Analysis]:
    made = Analysis(lambda: None)
    yield made
    made.thread.shutdown()


def request(quantity: Quantity) -> Request:
    wavefront = bowl()
    return Request(wavefront, quantity, lambda _: quantity_maps(wavefront, quantity, BENCH.reconstruction))


def made(of: object, compute: Callable[[], Any], *, choice: object = None, interval_s: float = 0.0) -> Request:
    return Request(of, choice, lambda _: compute(), interval_s)


def wait(analysis: Analysis) -> Future[Any]:
    deadline_s = time.monotonic() + HANG_S
    while time.monotonic() < deadline_s:
        if (result := analysis.take()) is not None:
            return result
        time.sleep(0.005)
    raise TimeoutError


def test_repeated_request_is_ignored_and_new_wavefront_waits(analysis: Analysis) -> None:
    first = request(Quantity.PSF)
    began_s = time.monotonic()  # the second waits from here, however long the first takes
    analysis.submit(first)
    wait(analysis)
    assert analysis.request is first
    analysis.submit(first)
    assert not analysis.is_busy
    while not analysis.is_busy:
        analysis.submit(request(Quantity.PSF))
    assert time.monotonic() - began_s > 0.1
    wait(analysis)
    analysis.submit(request(Quantity.RESIDUAL))  # a choice of the user is analysed immediately
    assert analysis.is_busy
    wait(analysis)
    analysis.submit(None)  # the panel is hidden
    analysis.submit(first)
    assert analysis.is_busy


def test_first_analysis_which_imports_packages_does_not_delay_the_next(analysis: Analysis) -> None:
    analysis.submit(made(1, partial(time.sleep, 1.0)))
    wait(analysis)
    analysis.submit(made(2, lambda: None, interval_s=0.2))
    assert analysis.is_busy


def test_error_of_analysis_is_returned_and_thread_continues(analysis: Analysis) -> None:
    def fail() -> None:
        raise NotImplementedError("broken")

    analysis.submit(made(1, fail))
    assert isinstance(wait(analysis).exception(), NotImplementedError)
    analysis.submit(request(Quantity.PSF))
    assert wait(analysis).result() is not None


def test_slow_analysis_leaves_the_measurement_most_of_a_core(analysis: Analysis) -> None:
    requested_s: list[float] = []
    number = 0
    analysis.submit(made(number, lambda: None))
    wait(analysis)
    while len(requested_s) < 5:
        number += 1
        analysis.submit(made(number, partial(time.sleep, 0.05)))
        analysis.take()
        if analysis._requested_s not in requested_s:
            requested_s.append(analysis._requested_s)
        time.sleep(0.002)
    assert np.diff(requested_s).min() >= 4.9 * 0.05
