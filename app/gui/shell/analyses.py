"""Computes what the panels request, on threads of its own, and shows them the results."""

import math
import time
from collections.abc import Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any

from PyQt6.QtCore import QObject, pyqtSignal

from app.cache import loading
from app.gui.panels.panel import Check, DisplayState, Panel, Request
from reconstruction.runtime.threads import one_blas_thread

_SHARE = 0.15  # of a core, for each panel: the measurement needs the rest


class Analysis:
    """Computes the requests of a panel one at a time, those of a running measurement at intervals."""

    def __init__(self, check: Check) -> None:
        """`check` raises to end a computation."""
        self.thread, self._check = ThreadPoolExecutor(1, thread_name_prefix="analysis"), check
        self.request: Request | None = None  # the last one
        self._result: Future[Any] | None = None  # until it is taken
        self._requested_s, self._taken_s = -math.inf, math.nan  # by the last one; none before the first

    @property
    def is_busy(self) -> bool:
        """True until the result is taken."""
        return self._result is not None

    def submit(self, request: Request | None) -> None:
        """Compute a request unless the last one is computed, or it is unchanged.

        A new measurement alone waits until the interval is over, and long enough that the analysis takes only a share
        of a core; any other change is analysed immediately.
        """
        last, now_s = self.request, time.monotonic()
        if self.is_busy:
            return
        if request is not None and last is not None and request.choice == last.choice:
            due_s = self._requested_s + max(request.interval_s, self._taken_s / _SHARE)
            if request.of is last.of or now_s < due_s:
                return
        self.request = request
        if request is not None:
            self._requested_s, self._result = now_s, self.thread.submit(self._compute, request)

    def take(self) -> Future[Any] | None:
        """Return the result once, when it is finished."""
        if self._result is None or not self._result.done():
            return None
        result, self._result = self._result, None
        return result

    def forget(self) -> None:
        self.request = self._result = None

    def _compute(self, request: Request) -> Any:
        """Compute on one core: waiting BLAS threads take five times as long during a measurement."""
        begun_s, is_first = time.monotonic(), math.isnan(self._taken_s)
        try:
            with one_blas_thread(), loading() if is_first else nullcontext():  # it may import packages
                return request.compute(self._check)
        finally:
            self._taken_s = 0.0 if is_first else time.monotonic() - begun_s  # nor does it delay the next one


class Analyses(QObject):
    """Asks the panels what to compute, each on a thread of its own."""

    failed = pyqtSignal(str)

    def __init__(self, panels: Iterable[Panel], shown: DisplayState) -> None:
        super().__init__(shown)
        self._shown, self.is_closing = shown, False
        self.of = {panel: Analysis(self._check) for panel in panels}
        shown.view_chosen.connect(self.poll)

    def poll(self) -> None:
        """Show results and compute what is requested now; called at each refresh of the window."""
        for panel, analysis in self.of.items():
            if (result := analysis.take()) is not None:
                self._show(panel, analysis, result)
            analysis.submit(panel.request() if panel.is_needed else None)
        if self._shown.wavefront is None:
            for panel in self.of:
                panel.show_nothing()

    def forget_bench(self) -> None:
        for analysis in self.of.values():
            analysis.forget()

    def close(self) -> None:
        """Wait for the current analyses and end their threads."""
        self.is_closing = True
        for analysis in self.of.values():
            analysis.thread.shutdown(cancel_futures=True)

    def _show(self, panel: Panel, analysis: Analysis, result: Future[Any]) -> None:
        """Show a result unless another choice was made meanwhile, or the panel was hidden."""
        now = panel.request() if panel.is_needed else None
        if (error := result.exception()) is not None:
            self.failed.emit(f"Analysis failed: {error}")
        elif now is not None and analysis.request is not None and now.choice == analysis.request.choice:
            panel.show_result(result.result())
        else:
            analysis.request = None  # to be computed again when it is seen

    def _check(self) -> None:
        if self.is_closing:
            raise CancelledError
