"""The transmission panel: what the sample lets through, at every view of the field."""

import numpy as np

from app.gui.panels.panel import Panel, Request, Shown
from app.gui.widgets.layouts import column
from app.gui.widgets.presentation import number
from app.gui.widgets.scales import ColourScale
from app.gui.widgets.texts import ElidedLabel
from app.gui.widgets.view_grid import Maps, ViewGrid
from reconstruction.arrays import Floats

_STEP = 0.1  # of the ends of the colour scale


class TransmissionPanel(Panel):
    """One map of the lenslets for each position of the field, all on one colour scale."""

    title = "Transmission"

    def __init__(self, shown: Shown) -> None:
        super().__init__(shown)
        self.grid = ViewGrid((80, 50), is_captioned=False)
        self.grid.setToolTip(
            "Brightness of the source through the sample over that in the reference.\n"
            "Hatched lenslets are lost or partly covered."
        )
        self.grid.selected.connect(shown.choose_view)
        self.sentence = ElidedLabel()
        column((self.grid, 1), self.sentence, parent=self)

    def request(self) -> Request | None:
        wavefront = self.shown.wavefront
        if wavefront is None or not self.isVisible():
            return None
        return Request(wavefront, None, lambda _: wavefront.transmission)

    def show_result(self, found: tuple[Floats, Floats] | None) -> None:
        known = np.zeros(0) if found is None else found[0][np.isfinite(found[0])]
        if found is None or not known.size:
            self.show_nothing()
            unknown = "This registration method does not measure the transmission"
            self.sentence.setText(unknown if found is None else "No lenslet has a transmission")
            return
        values, sigma = found
        low, high = np.floor(known.min() / _STEP) * _STEP, np.ceil(known.max() / _STEP) * _STEP
        scale = ColourScale("inferno", float(low), float(max(high, low + _STEP)), "", (0.0, 0.5, 1.0))
        self.grid.show_maps(Maps(values, scale, lambda *at: "row {}, column {}: ".format(*at) + number(at[-1])))
        self.sentence.setText(
            f"Mean {number(float(known.mean()))}, RMS {number(float(known.std()))},"
            f" error {number(float(np.nanmean(sigma)))} by noise"
        )

    def show_nothing(self) -> None:
        self.grid.show_maps(None)
        self.sentence.setText("")
