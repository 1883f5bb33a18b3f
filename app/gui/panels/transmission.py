"""The transmission panel: what the sample lets through, at every view of the field."""

import math

from app.gui.panels.panel import DisplayState, Panel, Request
from app.gui.widgets.layouts import column
from app.gui.widgets.presentation import linear, number
from app.gui.widgets.texts import ElidedLabel
from app.gui.widgets.view_grid import Maps, ViewGrid
from app.results.view_maps import TransmissionMaps, transmission_maps

_STEP = 0.1  # of the ends of the colour scale


class TransmissionPanel(Panel):
    """One map of the lenslets for each position of the field, all on one colour scale."""

    title = "Transmission"

    def __init__(self, shown: DisplayState) -> None:
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
        return Request(wavefront, None, lambda _: transmission_maps(wavefront))

    def show_result(self, found: TransmissionMaps | None) -> None:
        if found is None or math.isnan(found.mean):
            self.show_nothing()
            unknown = "This registration method does not measure the transmission"
            self.sentence.setText(unknown if found is None else "No lenslet has a transmission")
            return
        low, high = math.floor(found.lowest / _STEP) * _STEP, math.ceil(found.highest / _STEP) * _STEP
        scale = linear(low, max(high, low + _STEP))
        self.grid.show_maps(Maps(found.values, scale, lambda *at: "row {}, column {}: ".format(*at) + number(at[-1])))
        mean, sigma, noise = map(number, (found.mean, found.sigma, found.noise))
        self.sentence.setText(f"Mean {mean}, RMS {sigma}, error {noise} by noise")

    def show_nothing(self) -> None:
        self.grid.show_maps(None)
        self.sentence.setText("")
