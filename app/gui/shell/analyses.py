"""Analyses: computes what the visible panels request, on threads of its own, and shows them the results."""

import math
import time
from collections.abc import Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import Any

from PyQt6.QtCore import QObject, pyqtSignal

from app.gui.panels.panel import Check, Panel, Request, Shown
from app.gui.widgets.timers import REFRESH_MS, timer
from reconstruction.runtime.threads import one_blas_thread

_SHARE = 0.2  # of a core: the measurement needs the rest

Results = list[tuple[Panel, Request, Future[Any]]]


class AnalysisThread:
    """Computes the requests of its panels, together and one at a time, those of a running measurement at intervals."""

    def __init__(self, check: Check) -> None:
        """`check` raises to end a computation."""
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="analysis")
        self._check = check
        self.requests: dict[Panel, Request] = {}  # the last ones
        self._results: Results = []  # of those, until they are taken
        self._requested_s = -math.inf
        self._taken_s = 0.0  # by the last analyses

    @property
    def is_busy(self) -> bool:
        """True until the results are taken."""
        return bool(self._results)

    def submit(self, requests: dict[Panel, Request]) -> None:
        """Compute requests unless the thread is busy or all are unchanged.

        A new measurement alone waits until the interval is over, and long enough that analyses take only a share of a
        core; any other change is analysed immediately.
        """
        if self.is_busy or not requests:
            return
        known = [self.requests.get(panel) for panel in requests]
        pairs = list(zip(known, requests.values(), strict=True))
        if all(old is not None and old.choice == new.choice for old, new in pairs):
            if all(old is not None and old.of is new.of for old, new in pairs):
                return
            interval_s = max(request.interval_s for request in requests.values())
            if time.monotonic() < self._requested_s + max(interval_s, self._taken_s / _SHARE):
                return
        self.requests, self._requested_s, self._taken_s = requests, time.monotonic(), 0.0
        self._results = [
            (panel, request, self._executor.submit(self._compute, request)) for panel, request in requests.items()
        ]

    def take(self) -> Results:
        """Return the results once, when all are finished."""
        if not all(future.done() for _, _, future in self._results):
            return []
        results, self._results = self._results, []
        return results

    def forget(self) -> None:
        self.requests, self._results = {}, []

    def close(self) -> None:
        """Wait for the current analysis and end the thread."""
        self._executor.shutdown(cancel_futures=True)

    def _compute(self, request: Request) -> Any:
        """Compute on one core: waiting BLAS threads take five times as long beside a measurement."""
        begun_s = time.monotonic()
        try:
            with one_blas_thread():
                return request.compute(self._check)
        finally:
            self._taken_s += time.monotonic() - begun_s


class Analyses(QObject):
    """Asks the panels what to compute; they share a thread unless they have their own."""

    failed = pyqtSignal(str)

    def __init__(self, panels: Iterable[Panel], shown: Shown) -> None:
        super().__init__(shown)
        self._panels, self._shown = tuple(panels), shown
        self.is_closing = False
        quick = AnalysisThread(self._check)
        self.threads = {panel: AnalysisThread(self._check) if panel.has_own_thread else quick for panel in self._panels}
        shown.view_chosen.connect(self.poll)
        self._timer = timer(self, REFRESH_MS, self.poll)
        self._timer.start()

    def poll(self) -> None:
        self._shown.has_open_tabs = any(panel.isVisible() for panel in self._panels if panel.place == "tab")
        for thread in dict.fromkeys(self.threads.values()):
            for result in thread.take():
                self._show(thread, *result)
            requests = ((panel, panel.request()) for panel in self._panels if self.threads[panel] is thread)
            thread.submit({panel: request for panel, request in requests if request is not None})
        if self._shown.wavefront is None:
            for panel in self._panels:
                panel.show_nothing()

    def forget_bench(self) -> None:
        for thread in self.threads.values():
            thread.forget()

    def close(self) -> None:
        self._timer.stop()
        self.is_closing = True
        for thread in self.threads.values():
            thread.close()

    def _show(self, thread: AnalysisThread, panel: Panel, request: Request, result: Future[Any]) -> None:
        """Show a result unless another choice was made meanwhile, or the panel was hidden."""
        now = panel.request()
        if (error := result.exception()) is not None:
            self.failed.emit(f"Analysis failed: {error}")
        elif now is not None and now.choice == request.choice:
            panel.show_result(result.result())
        else:
            thread.requests.pop(panel, None)  # to be computed again when it is seen

    def _check(self) -> None:
        if self.is_closing:
            raise CancelledError
