"""The analysis thread: computes only what is requested, and nothing twice."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.gui_bench import BENCH
from support.patience import HANG_S
from support.wavefronts import bowl

from app.gui.analysis_thread import AnalysisThread
from app.results.view_analysis import Analysis, AnalysisRequest, Quantity, analyse
from reconstruction.arrays import Floats
from reconstruction.wavefront import Wavefront


def request(quantity: Quantity, wavefront: Wavefront | None = None) -> AnalysisRequest:
    return AnalysisRequest(wavefront or bowl(), BENCH.reconstruction, quantity, None, None)


@pytest.fixture
def thread() -> Iterator[AnalysisThread[AnalysisRequest, Analysis]]:
    made = AnalysisThread(analyse)
    yield made
    made.close()


def wait(thread: AnalysisThread[AnalysisRequest, Analysis]) -> Analysis:
    deadline_s = time.monotonic() + HANG_S
    while time.monotonic() < deadline_s:
        analysis = thread.take()
        if analysis is not None:
            return analysis
        time.sleep(0.005)
    raise TimeoutError


def test_repeated_request_is_ignored_and_new_wavefront_waits(thread: AnalysisThread[AnalysisRequest, Analysis]) -> None:
    first = request(Quantity.PSF)
    began_s = time.monotonic()  # the second waits from here, however long the first takes
    thread.submit(first)
    assert wait(thread).request is first
    thread.submit(first)
    assert thread._future is None
    second = request(Quantity.PSF)
    while thread._future is None:
        thread.submit(second)
    assert time.monotonic() - began_s > 0.1
    wait(thread)
    thread.submit(replace(second, quantity=Quantity.DIFFERENCE))  # a choice of the user is analysed immediately
    assert thread._future is not None


def test_error_of_analysis_is_raised_and_thread_continues(thread: AnalysisThread[AnalysisRequest, Analysis]) -> None:
    class Broken:
        def wavefront(self, field_modes: Floats) -> Floats:
            raise NotImplementedError("broken")

        sigma = wavefront

    thread.submit(request(Quantity.UNCERTAINTY, replace(bowl(), solution=Broken())))  # type: ignore[arg-type] # a stand-in
    with pytest.raises(NotImplementedError, match="broken"):
        wait(thread)
    thread.submit(request(Quantity.PSF))
    assert wait(thread).maps is not None


@dataclass(frozen=True)
class Numbered:
    """A request that a newer one replaces at once."""

    number: int
    interval_s: float = 0.0

    def follows(self, other: Numbered) -> bool:
        return isinstance(other, Numbered)


def test_slow_analysis_leaves_the_measurement_most_of_a_core() -> None:
    requested_s: list[float] = []
    thread = AnalysisThread[Numbered, None](lambda _: time.sleep(0.05))
    try:
        number = 0
        while len(requested_s) < 5:
            number += 1
            thread.submit(Numbered(number))
            thread.take()
            if thread._requested_s not in requested_s:
                requested_s.append(thread._requested_s)
            time.sleep(0.002)
        assert np.diff(requested_s).min() >= 4.9 * 0.05
    finally:
        thread.close()
