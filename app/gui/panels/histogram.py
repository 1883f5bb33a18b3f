"""The histogram of the camera's newest frame."""

import numpy as np
import pyqtgraph as pg
from PyQt6.QtGui import QColor

from app.gui.panels.panel import DisplayState, Panel
from app.gui.widgets import theme
from app.gui.widgets.layouts import column
from app.gui.widgets.plot import Plot
from app.gui.widgets.presentation import percent
from app.results.frame_statistics import NEARLY_FULL


class HistogramPanel(Panel):
    """Number of pixels over counts, on a logarithmic scale, with lines at full and nearly full pixels."""

    title = "Histogram"

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        keys = ((percent(NEARLY_FULL), theme.AMBER), ("clipped", theme.RED))
        self.plot = Plot("Histogram", "counts", keys, widest="10000")
        self.plot.setToolTip(
            f"Number of pixels over their counts. The brightest should be below {keys[0][0]} of the level that clips."
        )
        self.curve = pg.PlotCurveItem(x=[0, 1], y=[0], stepMode="center", fillLevel=0)
        self.plot.view.addItem(self.curve)
        theme.follow(self.plot, self._colour)
        self._lines = [self.plot.add_line(colour, 90) for _, colour in keys]
        self.plot.axes["left"].setTicks([[(decade, f"{10**decade}") for decade in range(8)]])
        column(self.plot, parent=self)

    def _colour(self) -> None:
        self.curve.setPen(pg.mkPen(theme.ACCENT, width=1))
        fill = QColor(theme.ACCENT)
        fill.setAlpha(100)
        self.curve.setBrush(fill)

    def show_numbers(self) -> None:
        found = self.shown.statistics
        if found is None or not self.isVisible():
            return
        self.curve.setData(found.level, np.log10(np.maximum(found.pixels, 0.8)))
        for line, part in zip(self._lines, (NEARLY_FULL, 1.0), strict=True):
            line.setValue(part * found.clip_level)
        self.plot.set_ranges((0, float(found.level[-1])), (0, float(np.log10(max(found.pixels.max(), 10))) + 0.2))
        share = f", {percent(found.clipped_share, 2)} of the pixels clipped" if found.clipped_share else ""
        self.plot.title.setText(f"Histogram: peak {found.peak} of {found.clip_level} counts{share}")
