"""Between the panels and the analyst: asks what they show, and passes on what was found out."""

from __future__ import annotations

from PyQt6.QtCore import QObject, QTimer, pyqtSignal

from app.bench.config import Bench
from app.gui.analysis import Analyst, Quantity, Question
from app.gui.analysis_panel import AnalysisPanel
from app.gui.wavefront_panel import WavefrontPanel
from reconstruction.wavefront import Wavefront

_LOOK_INTERVAL_MS = 40


class LiveAnalysis(QObject):
    """Has analysed what is seen, and nothing that is not."""

    failed = pyqtSignal(str)  # why there is no answer

    def __init__(self, wavefront_panel: WavefrontPanel, analysis_panel: AnalysisPanel, parent: QObject) -> None:
        """Begin to ask as soon as there are a bench and a wavefront."""
        super().__init__(parent)
        self._wavefront_panel, self._analysis_panel = wavefront_panel, analysis_panel
        self._analyst = Analyst()
        self._bench: Bench | None = None
        self._wavefront: Wavefront | None = None
        self._view: tuple[int, int] | None = None  # None is the one in the middle
        wavefront_panel.grid.selected.connect(self._select)
        self._timer = QTimer(self)
        self._timer.setInterval(_LOOK_INTERVAL_MS)
        self._timer.timeout.connect(self.look)
        self._timer.start()

    def show_bench(self, bench: Bench) -> None:
        """Say on what the wavefronts are measured."""
        self._bench = bench

    def show_wavefront(self, wavefront: Wavefront | None) -> None:
        """Say what the newest wavefront is; None when there is none."""
        if wavefront is None and self._wavefront is not None:
            self._analysis_panel.show_nothing()
        self._wavefront = wavefront

    def look(self) -> None:
        """Show what has been found out, and ask on."""
        try:
            answer = self._analyst.answer()
        except Exception as error:  # noqa: BLE001 - whatever it is, it is told; the measurement goes on
            self.failed.emit(f"analysis: {error}")
            answer = None
        if answer is not None and self._wavefront is not None:
            self._wavefront_panel.show_analysis(answer)
            self._analysis_panel.show_analysis(answer)
        view = self._selected() if self._analysis_panel.isVisible() else None
        self._wavefront_panel.grid.select(view)
        quantity = self._wavefront_panel.quantity
        if self._wavefront is None or self._bench is None or (view is None and quantity is Quantity.WAVEFRONT):
            return
        self._analyst.ask(Question(self._wavefront, self._bench, quantity, self._wavefront_panel.reach_rad, view))

    def close(self) -> None:
        """End the analyst's thread."""
        self._timer.stop()
        self._analyst.close()

    def _select(self, row: int, column: int) -> None:
        self._view = (row, column)
        self.look()

    def _selected(self) -> tuple[int, int] | None:
        """The selected view, if there is such a one; else the one in the middle."""
        if self._wavefront is None:
            return None
        rows, columns = self._wavefront.views.shape[:2]
        if self._view is not None and self._view[0] < rows and self._view[1] < columns:
            return self._view
        return rows // 2, columns // 2
