"""The layers panel: misfit over the distance, and the phase of the found layers."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

import numpy as np
from PyQt6.QtCore import QSignalBlocker, Qt

from app.gui.panels.panel import DisplayState, Panel, Request
from app.gui.widgets import theme
from app.gui.widgets.buttons import Choice
from app.gui.widgets.layouts import column, row
from app.gui.widgets.plot import Plot
from app.gui.widgets.presentation import AdaptiveScale, diverging, number, signed
from app.gui.widgets.texts import ElidedLabel
from app.gui.widgets.view_grid import Caption, Maps, ViewGrid
from app.results.layers import Origin, axis_label, distance_in_words, find_shown_layers, shown_range_m
from reconstruction.arrays import Floats

if TYPE_CHECKING:
    import xarray as xr

_SEARCHING = "Searching\N{HORIZONTAL ELLIPSIS}"
_INTERVALS_S = {1: 5.0, 2: 20.0}  # between two searches, by the number of layers


class MisfitPlot(Plot):
    """Misfit of a single layer over its distance, a dashed limit, and a vertical line at each distance found."""

    def __init__(self) -> None:
        keys = (("one layer", theme.ACCENT), ("found", theme.AMBER), ("limit", theme.DIM))
        super().__init__("Unexplained (%)", axis_label("lenslets"), keys, widest="100")
        self.graphics.setMinimumHeight(3 * self.fontMetrics().height())  # the window fits small screens
        self.setToolTip(
            "Share of the displacements (RMS) that a single layer at each distance does not explain.\n"
            "The dashed line is any wavefront, without layers."
        )
        self.level = self.add_curve(theme.DIM, 1, Qt.PenStyle.DashLine)
        self.curve, self.marks = self.add_curve(theme.ACCENT), self.add_curve(theme.AMBER)

    def show_misfits(self, distance_m: Floats, misfits: Floats, limit: float, found_m: Floats, origin: Origin) -> None:
        """Show misfits over distances (distance,), m, on an axis about those that were found (found,)."""
        distance_mm = distance_m * 1e3
        low_mm, high_mm = (1e3 * end_m for end_m in shown_range_m(found_m, distance_m, origin))
        self.curve.setData(distance_mm, misfits)
        self.level.setData([low_mm, high_mm], [limit, limit])
        self.axes["bottom"].setLabel(axis_label(origin))
        shown = misfits[(low_mm <= distance_mm) & (distance_mm <= high_mm)]
        top = 1.1 * max(float(shown.max()), limit, 1e-6)
        self.set_ranges((low_mm, high_mm), (0, top))
        self.marks.setData(np.repeat(found_m * 1e3, 2), np.tile([0.0, top], found_m.size), connect="pairs")


class LayersPanel(Panel):
    """Asks for layers while it is visible, and shows them."""

    title = "Layers"

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self._scale = AdaptiveScale()
        self.sentence = ElidedLabel(lines=2)
        modes = (("Find one layer", 1), ("Find two layers", 2))
        self.mode = Choice(
            "Search for one or two layers every few seconds", modes, lambda: self.sentence.setText(_SEARCHING)
        )
        about = (
            "Where distances are measured from: lenslets, in the collimated beam, or mask.\n"
            "From the lenslets, negative distances lie behind them; there is no distance from the mask there."
        )
        self.origin = Choice(about, [(f"From the {origin}", origin) for origin in get_args(Origin)])
        self.plot = MisfitPlot()
        self.map = ViewGrid((80, 50))
        self.map.setToolTip("Phase of each layer, without piston")
        header = row(self.mode, self.origin, (ElidedLabel(), 1))
        column(header, (row((self.plot, 3), (self.map, 2), spacing=12), 1), self.sentence, parent=self)
        self.forget_bench()

    def forget_bench(self) -> None:
        self.sentence.setText(_SEARCHING)
        self.map.empty = _SEARCHING
        self.map.show_maps(None)
        self.plot.clear()

    def request(self) -> Request | None:
        measurement, origin, count = self.shown.measurement, self.origin.currentData(), self.mode.currentData()
        if measurement is None or measurement.wavefront is None:
            return None
        return Request(
            measurement,
            (origin, count),
            lambda check: find_shown_layers(measurement, origin, count=count, check=check),
            _INTERVALS_S[count],
        )

    def show_result(self, found: xr.Dataset | str) -> None:
        if isinstance(found, str):
            self.map.empty = "no layer"
            self.sentence.setText(f"No layer: {found}")
            self.show_nothing()
            return
        self.sentence.setText(_in_words(found))
        origin, at_m = found.attrs["distances_from"], found["distance_m"].values
        with QSignalBlocker(self.origin):  # another than was chosen, if a layer has no distance from that one
            self.origin.setCurrentIndex(self.origin.findData(origin))
        misfits, least = 100 * found["misfit"].values, 100 * _misfit(found, "any wavefront")
        self.plot.show_misfits(found["distance"].values, misfits, least, at_m, origin)
        self._show_maps(found)

    def show_nothing(self) -> None:
        """Show the maps in grey: they are not those of the newest frame."""
        self.map.show_stale(is_stale=True)

    def _show_maps(self, found: xr.Dataset) -> None:
        values = found["layer_phase"].values * self.shown.per_rad
        limit = self._scale.follow(float(found["phase_limit"].max()) * self.shown.per_rad)
        reach_mm = (float(found["x"][-1]) * 1e3, float(found["y"][-1]) * 1e3)
        unit = str(self.shown.unit)

        def describe(row: int, column: int, value: float) -> str:
            last = values.shape[1] - 1, values.shape[2] - 1
            x_mm, y_mm = reach_mm[0] * (2 * column / last[1] - 1), reach_mm[1] * (2 * row / last[0] - 1)
            text = f"{signed(value)} {unit}" if np.isfinite(value) else "no ray meets the layer"
            return f"{x_mm:+.2f}, {y_mm:+.2f} mm on the layer: {text}"

        self.map.is_stale = self.shown.data_freshness.is_grey
        scale = diverging(limit, unit)
        self.map.show_maps(Maps(values[None], scale, describe, is_smooth=True, reach=reach_mm, reach_unit="mm"))
        wide = (f"map {2 * reach_mm[0]:.1f} mm wide", f"{2 * reach_mm[0]:.1f} mm wide")  # not after +-
        captions: dict[tuple[int, int], Caption] = {}
        for index, (at_m, place) in enumerate(zip(found["distance_m"].values, _places(found), strict=True)):
            at = (place, f"{at_m * 1e3:.1f} mm")
            captions[0, index] = (at, wide)
        self.map.set_captions(captions)


def _misfit(found: xr.Dataset, model: str) -> float:
    return float(found["model_misfit"].sel(model=model))


def _places(found: xr.Dataset) -> list[str]:
    at = zip(found["distance_m"].values, found["distance_sigma_m"].values, strict=True)
    return [distance_in_words(*each, found.attrs["distances_from"]) for each in at]


def _in_words(found: xr.Dataset) -> str:
    places, verdict, layers = " and ".join(_places(found)), found.attrs["verdict"], found.sizes["layer"]
    fitted = "two layers" if layers > 1 else "one layer"
    share = f"{number(100 * _misfit(found, fitted), 2)} % of the displacements unexplained"
    share += f" (any wavefront: {number(100 * _misfit(found, 'any wavefront'), 2)} %)"
    doubt = f"; but {found.attrs['doubt']}" if found.attrs["doubt"] else ""
    if verdict.startswith("nothing"):
        return f"{verdict.capitalize()}: no layer to be found{doubt}"
    if verdict.startswith(("not", "farther")):
        return f"{verdict.capitalize()}: the best, {places}, leave{'s' * (layers == 1)} {share}{doubt}"
    return f"{verdict.capitalize()} {places}: {share}{doubt}"
