"""Tabs below the camera image, from quality to layers and corrector. Hidden ones compute nothing."""

from PyQt6.QtCore import QObject, pyqtSignal
from PyQt6.QtWidgets import QWidget

from app.gui.analysis_panel import AnalysisPanel
from app.gui.coefficients_panel import CoefficientsPanel
from app.gui.corrector_panel import CorrectorPanel
from app.gui.histogram_panel import HistogramPanel
from app.gui.history_panel import HistoryPanel
from app.gui.layers_panel import LayersPanel
from app.gui.lenslet_panel import LensletPanel
from app.gui.wavefront_panel import WavefrontPanel
from app.measurement.measurement import Measurement
from app.results.history import History, sample
from app.results.layers import FoundLayers
from app.results.view_analysis import Analysis


class AnalysisTabs(QObject):
    """The panels; each computes nothing while it is hidden."""

    panel_requested = pyqtSignal(QWidget)

    def __init__(self, wavefront_panel: WavefrontPanel, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._wavefront_panel = wavefront_panel
        self._measurement: Measurement | None = None
        self.quality, self.coefficients, self.history = AnalysisPanel(), CoefficientsPanel(), HistoryPanel()
        self.histogram, self.lenslet = HistogramPanel(), LensletPanel()
        self.layers, self.corrector = LayersPanel(), CorrectorPanel()
        self.coefficients.pinned.connect(self.history.pin)
        self.panels: dict[str, QWidget] = {
            "Quality": self.quality,
            "Coefficients": self.coefficients,
            "History": self.history,
            "Histogram": self.histogram,
            "Lenslet": self.lenslet,
            "Layers": self.layers,
            "Corrector": self.corrector,
        }

    @property
    def is_visible(self) -> bool:
        """True if a panel is visible."""
        return any(panel.isVisible() for panel in self.panels.values())

    def show_analysis(self, analysis: Analysis) -> None:
        """Show what was computed for the visible tab."""
        self.quality.show_analysis(analysis)
        wavefront, unit = analysis.request.wavefront, self._wavefront_panel.menu.unit
        self.coefficients.use_unit(unit, unit.per_rad(wavefront.sensor.wavelength_m))
        if analysis.coefficients is not None:
            self.coefficients.show_coefficients(analysis.coefficients)
        if analysis.request.lenslet is not None:
            self.lenslet.show_inspection(analysis.inspection)

    def show_layers(self, found: FoundLayers) -> None:
        """Show layers in the unit of the wavefronts."""
        wavefront, unit = found.request.measurement.wavefront, self._wavefront_panel.menu.unit
        if wavefront is not None:
            self.layers.use_unit(unit, unit.per_rad(wavefront.sensor.wavelength_m))
        self.layers.show_layers(found)

    def inspect(self, row: int, column: int) -> None:
        """Show a lenslet in its tab."""
        self.lenslet.select((row, column))
        self.panel_requested.emit(self.lenslet)

    def forget_bench(self) -> None:
        """Forget the inspected lenslet, the pinned coefficient and the history of another bench."""
        self.lenslet.select(None)
        self.coefficients.pin(None)
        self.history.history = History()
        self._measurement = None

    def show_nothing(self) -> None:
        """Clear the tabs: there is no wavefront."""
        self.quality.show_nothing()
        self.coefficients.show_coefficients(None)
        self.layers.show_stale()
        self.lenslet.show_nothing()

    def record(self, measurement: Measurement, *, full_scale: float, temperature_c: float | None) -> None:
        """Add a measurement to the history."""
        if measurement is self._measurement:
            return
        self._measurement = measurement
        values = sample(
            measurement.frame,
            self._wavefront_panel.shown,
            full_scale=full_scale,
            delay_s=measurement.latency_s,
            temperature_c=temperature_c,
        )
        pinned_rad = self.coefficients.pinned_rad()
        if self.coefficients.name and pinned_rad is not None:
            values[self.coefficients.name] = pinned_rad
        if (shown := self._wavefront_panel.shown) is not None:
            unit = self._wavefront_panel.menu.unit
            self.history.use_unit(unit, unit.per_rad(shown.sensor.wavelength_m))
        self.history.add(measurement.frame.host_time_s, values)
