"""Background analysis: computes the maps and plots of the panels on its own thread."""

import math
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

from PyQt6.QtCore import QObject, QTimer, pyqtSignal
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped] # ships no types

from app.gui.analysis_tabs import AnalysisTabs
from app.gui.wavefront_panel import WavefrontPanel
from app.measurement.measurement import Measurement
from app.results.view_analysis import Analysis, AnalysisRequest, Quantity, analyse
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront

_INTERVAL_S = 0.2  # between two analyses of a running measurement
_POLL_INTERVAL_MS = 40


class AnalysisThread:
    """Analyses one request at a time, and a running measurement five times a second."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="analysis")
        self._libraries = ThreadpoolController()
        self._request: AnalysisRequest | None = None
        self._future: Future[Analysis] | None = None
        self._requested_s = -math.inf

    def submit(self, request: AnalysisRequest) -> None:
        """Analyse a request unless the thread is busy or the request is unchanged.

        A new wavefront alone waits until the interval is over; any other change is analysed immediately.
        """
        if self._future is not None or request == self._request:
            return
        differs_by_wavefront = (
            self._request is not None
            and replace(request, wavefront=self._request.wavefront, measurement=self._request.measurement)
            == self._request
        )
        if differs_by_wavefront and time.monotonic() < self._requested_s + _INTERVAL_S:
            return
        self._request, self._requested_s = request, time.monotonic()
        self._future = self._executor.submit(self._analyse, request)

    def take(self) -> Analysis | None:
        """Return a finished analysis once, or raise its error; None if there is none."""
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        return future.result()

    def close(self) -> None:
        """Wait some milliseconds for the current analysis and end the thread."""
        self._executor.shutdown(cancel_futures=True)

    def _analyse(self, request: AnalysisRequest) -> Analysis:
        """Analyse on one core: waiting BLAS threads take five times as long beside a measurement."""
        with self._libraries.limit(limits=1, user_api="blas"):
            return analyse(request)


class BackgroundAnalysis(QObject):
    """Analyses the visible quantity and view, and shows the result."""

    failed = pyqtSignal(str)

    def __init__(self, wavefront_panel: WavefrontPanel, tabs: AnalysisTabs, parent: QObject) -> None:
        super().__init__(parent)
        self._wavefront_panel, self._tabs = wavefront_panel, tabs
        self._thread = AnalysisThread()
        self._measurement: Measurement | None = None
        self._settings: ReconstructionSettings | None = None
        self._view: tuple[int, int] | None = None  # None: the middle one
        wavefront_panel.grid.selected.connect(self._select)
        self._timer = QTimer(self)
        self._timer.setInterval(_POLL_INTERVAL_MS)
        self._timer.timeout.connect(self.poll)
        self._timer.start()

    def use_settings(self, settings: ReconstructionSettings) -> None:
        """Set how the wavefronts are reconstructed."""
        self._settings = settings

    def use_measurement(self, measurement: Measurement) -> None:
        """Set the newest measurement."""
        self._measurement = measurement

    @property
    def _wavefront(self) -> Wavefront | None:
        """The shown wavefront."""
        return self._wavefront_panel.shown

    def poll(self) -> None:
        """Show a finished analysis and request the next."""
        try:
            analysis = self._thread.take()
        except Exception as error:  # noqa: BLE001 - reported; the measurement continues
            self.failed.emit(f"Analysis failed: {error}")
            analysis = None
        if analysis is not None and self._wavefront is not None:
            self._wavefront_panel.show_analysis(analysis)
            self._tabs.show_analysis(analysis)
        wavefront, view = self._wavefront, self._selected_view()
        if wavefront is None:
            self._tabs.show_nothing()
        self._wavefront_panel.grid.select(view if self._tabs.is_visible else None)
        if wavefront is None or view is None or self._settings is None:
            return
        lenslet = self._tabs.lenslet.wanted()
        request = AnalysisRequest(
            wavefront,
            self._settings,
            self._wavefront_panel.quantity,
            self._wavefront_panel.reach_rad,
            view if self._tabs.quality.isVisible() else None,
            self._tabs.coefficients.choice(view, wavefront.displacement.modes.count),
            lenslet,
            None if lenslet is None else self._measurement,
        )
        wanted = (request.view, request.modes, request.lenslet)
        if request.quantity is not Quantity.WAVEFRONT or any(one is not None for one in wanted):
            self._thread.submit(request)

    def close(self) -> None:
        """End the thread."""
        self._timer.stop()
        self._thread.close()

    def _select(self, row: int, column: int) -> None:
        self._view = (row, column)
        self.poll()

    def _selected_view(self) -> tuple[int, int] | None:
        """Return the selected view if it exists, else the middle one."""
        if self._wavefront is None:
            return None
        rows, columns = self._wavefront.views.shape[:2]
        if self._view is not None and self._view[0] < rows and self._view[1] < columns:
            return self._view
        return rows // 2, columns // 2
