"""The corrector panel: what one corrector would leave, over its distance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.gui.panels.panel import DisplayState, Panel, Request
from app.gui.widgets import theme
from app.gui.widgets.buttons import Choice
from app.gui.widgets.layouts import column, row
from app.gui.widgets.plot import DistancePlot, origin_choice
from app.gui.widgets.texts import ElidedLabel
from app.results.corrector import DEFAULT, corrector_sentence, find_shown_correctors
from reconstruction.layers.corrector import Corrector

if TYPE_CHECKING:
    import xarray as xr

_CORRECTORS = (
    *(Corrector("zernike", count) for count in (10, 21, 45, 66)),
    *(Corrector("legendre", count) for count in (10, 21, 45, 66)),
    *(Corrector("actuators", side**2) for side in (5, 8, 12, 17)),
)


class CorrectorPanel(Panel):
    """Asks for the residuals of a corrector while it is visible, and shows them."""

    title = "Corrector"

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        choices = [(_name(one), one) for one in _CORRECTORS]
        self.corrector = Choice("Shapes that the corrector can take over its footprint", choices)
        self.corrector.setCurrentIndex(_CORRECTORS.index(DEFAULT))
        self.origin = origin_choice()
        keys = (("best command", theme.ACCENT), ("best distance", theme.AMBER), ("no corrector", theme.DIM))
        about = (
            "RMS of the wavefronts over field and pupil after the best command of one corrector,\n"
            "over the distance that the corrector is conjugate to. Measurement noise is part of it."
        )
        self.plot = DistancePlot("Residual (rad RMS)", keys, about, widest="00.0")
        self.sentence = ElidedLabel(lines=2)
        header = row(self.corrector, self.origin, (ElidedLabel(), 1))
        column(header, (self.plot, 1), self.sentence, parent=self)
        self.forget_bench()

    def forget_bench(self) -> None:
        self.sentence.setText("Computing \N{HORIZONTAL ELLIPSIS}")
        self.plot.clear()

    def request(self) -> Request | None:
        measurement, origin, corrector = self.shown.measurement, self.origin.currentData(), self.corrector.currentData()
        if measurement is None or measurement.wavefront is None:
            return None
        return Request(
            measurement,
            (origin, corrector),
            lambda _: find_shown_correctors(measurement, origin, corrector),
            interval_s=5.0,
        )

    def show_result(self, found: xr.Dataset | str) -> None:
        if isinstance(found, str):
            self.sentence.setText(f"No residual: {found}")
            return
        at_m, without_rad = found["corrector_distance_m"].values, float(found["uncorrected"])
        distance_m, residual_rad = found["distance"].values, found["residual"].values
        self.plot.show_curve(distance_m, residual_rad, without_rad, at_m, found.attrs["distances_from"])
        self.plot.mark(at_m)
        text = corrector_sentence(found)
        self.sentence.setText(text[0].upper() + text[1:])


def _name(corrector: Corrector) -> str:
    if corrector.influence == "actuators":
        side = round(corrector.count**0.5)
        return f"{side} x {side} actuators"
    return f"{corrector.count} {corrector.influence.capitalize()} modes"
