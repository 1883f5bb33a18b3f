"""Background analysis: computes the maps and plots of the panels on its own thread."""

from concurrent.futures import CancelledError
from typing import Any, TypeVar

from PyQt6.QtCore import QObject, QTimer, pyqtSignal

from app.gui.analysis_tabs import AnalysisTabs
from app.gui.analysis_thread import AnalysisThread
from app.gui.guard import Guard
from app.gui.wavefront_panel import WavefrontPanel
from app.measurement.measurement import Measurement
from app.results.corrector import find_shown_correctors
from app.results.layers import FoundLayers, LayersRequest, find_shown_layers
from app.results.view_analysis import AnalysisRequest, Quantity, analyse
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront

_POLL_INTERVAL_MS = 40

A = TypeVar("A")


class BackgroundAnalysis(QObject):
    """Analyses the visible quantity and view, and shows the result."""

    failed = pyqtSignal(str)

    def __init__(self, wavefront_panel: WavefrontPanel, tabs: AnalysisTabs, guard: Guard, parent: QObject) -> None:
        super().__init__(parent)
        self._wavefront_panel, self._tabs = wavefront_panel, tabs
        self._thread = AnalysisThread(analyse)
        self._layers = AnalysisThread(self._find_layers)  # a search takes seconds
        self._correctors = AnalysisThread(find_shown_correctors)
        self._is_closing = False
        self._measurement: Measurement | None = None
        self._settings: ReconstructionSettings | None = None
        self._view: tuple[int, int] | None = None  # None: the middle one
        wavefront_panel.grid.selected.connect(self._select)
        self._timer = QTimer(self)
        self._timer.setInterval(_POLL_INTERVAL_MS)
        self._timer.timeout.connect(guard(self.poll))
        self._timer.start()

    def use_settings(self, settings: ReconstructionSettings) -> None:
        """Set how the wavefronts are reconstructed."""
        self._settings = settings

    def use_measurement(self, measurement: Measurement) -> None:
        """Set the newest measurement."""
        self._measurement = measurement

    def forget_bench(self) -> None:
        """Forget the measurements of another bench."""
        self._measurement = None
        for thread in (self._thread, self._layers, self._correctors):
            thread.forget()

    @property
    def _wavefront(self) -> Wavefront | None:
        """The shown wavefront."""
        return self._wavefront_panel.shown

    def poll(self) -> None:
        """Show finished analyses and request the next."""
        self._poll_layers()
        self._poll_correctors()
        analysis = self._taken(self._thread)
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
        """End the threads."""
        self._timer.stop()
        self._is_closing = True
        for thread in (self._thread, self._layers, self._correctors):
            thread.close()

    def _poll_layers(self) -> None:
        if (found := self._taken(self._layers)) is not None:
            self._tabs.show_layers(found)
        if (request := self._tabs.layers.wanted(self._measurement)) is not None:
            self._layers.submit(request)

    def _poll_correctors(self) -> None:
        if (found := self._taken(self._correctors)) is not None:
            self._tabs.corrector.show_correctors(found)
        if (request := self._tabs.corrector.wanted(self._measurement)) is not None:
            self._correctors.submit(request)

    def _find_layers(self, request: LayersRequest) -> FoundLayers:
        return find_shown_layers(request, self._check)

    def _check(self) -> None:
        if self._is_closing:
            raise CancelledError

    def _taken(self, thread: AnalysisThread[Any, A]) -> A | None:
        """Return a finished analysis once; report its error."""
        try:
            return thread.take()
        except Exception as error:  # noqa: BLE001 - reported; the measurement continues
            self.failed.emit(f"Analysis failed: {error}")
            return None

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
