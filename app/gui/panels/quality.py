"""The quality panel: MTF of the selected view, isoplanatism over the field, and a one-line summary."""

import math
from functools import partial
from itertools import chain

import numpy as np
import pyqtgraph as pg
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor

from app.gui.panels.panel import SLOWER_S, Check, DisplayState, Panel, Request
from app.gui.widgets import theme
from app.gui.widgets.layouts import column, row
from app.gui.widgets.plot import Plot
from app.gui.widgets.presentation import AdaptiveScale, number, position_texts
from app.gui.widgets.texts import ElidedLabel
from reconstruction.arrays import Floats
from reconstruction.quality.image_quality import Mtf, mtf
from reconstruction.quality.isoplanatism import Isoplanatism, isoplanatism

_ERROR_DECIMALS = 6  # of the error in rad: less than a millionth is rounding


class QualityPanel(Panel):
    """Two plots and the summary below them."""

    title = "Quality"

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self.mtf = MtfPlot()
        self.structure = StructurePlot()
        self.sentence = ElidedLabel(lines=2)
        column((row((self.mtf, 1), (self.structure, 1), spacing=16), 1), self.sentence, parent=self)

    def request(self) -> Request | None:
        wavefront, view = self.shown.wavefront, self.shown.view
        if wavefront is None or view is None:
            return None

        options = self.shown.options

        def compute(_: Check) -> tuple[str, Mtf, Isoplanatism]:
            at_m = float(wavefront.field.view_x_m[view[1]]), float(wavefront.field.view_y_m[view[0]])
            where = ", ".join(filter(None, (position_texts(*at_m)[1], options)))
            return where, mtf(wavefront.views[view], wavefront.sensor), isoplanatism(wavefront)

        return Request(wavefront, (view, wavefront.field, options), compute, SLOWER_S)

    def show_result(self, result: tuple[str, Mtf | None, Isoplanatism | None]) -> None:
        where, transfer, found = result
        self.mtf.show_transfer(transfer, where)
        self.structure.show_structure(found)
        if found is not None:
            sentence = verdict(found)
            if self.shown.options:  # which do not apply to it
                sentence = f"Of the wavefronts as measured: {sentence[0].lower()}{sentence[1:]}"
            self.sentence.setText(sentence)
            self.sentence.setToolTip(
                f"{sentence}.\nThe correction is the mean wavefront of the field. The isoplanatic patch ends\n"
                "where two wavefronts differ by 1 rad RMS (mean square 1 rad\N{SUPERSCRIPT TWO}).\n"
                f"Tip and tilt removed, which only displace the image: {number(found.error_without_tilt_rad, 2)} rad"
                f" RMS; patch {_patch(found.curve_without_tilt.patch_m)}."
            )

    def show_nothing(self) -> None:
        self.mtf.show_transfer(None, "")
        self.structure.show_structure(None)
        self.sentence.setText("")


class MtfPlot(Plot):
    """MTF along x and y, up to the cut-off frequency of the pupil."""

    def __init__(self) -> None:
        super().__init__("MTF", "cycles per mrad", (("x", theme.ACCENT), ("y", theme.AMBER), ("limit", theme.DIM)))
        self.setToolTip(
            "Modulation transfer function of the selected view along x and y, and its diffraction limit.\n"
            "The pupil is the area of the valid lenslets. Click a view or use the arrow keys to select it."
        )
        self._limits = [self.add_curve(theme.DIM, 1, Qt.PenStyle.DashLine) for _ in "xy"]
        self._curves = [self.add_curve(colour) for colour in (theme.ACCENT, theme.AMBER)]
        self.axes["left"].setTicks([[(0, "0"), (0.5, "0.5"), (1, "1")]])
        self.set_ranges((0, 1), (0, 1))

    def show_transfer(self, transfer: Mtf | None, where: str) -> None:
        self.title.setText(f"MTF at {where}" if where else "MTF")
        if transfer is None:
            self.clear_curves()
            return
        frequencies = [one / 1e3 for one in (transfer.frequency_x_per_rad, transfer.frequency_y_per_rad)]
        self.set_ranges((0, max(float(one[-1]) for one in frequencies)), (0, 1))
        for curve, frequency, values in zip(
            (*self._limits, *self._curves),
            (*frequencies, *frequencies),
            (transfer.limit_x, transfer.limit_y, transfer.along_x, transfer.along_y),
            strict=True,
        ):
            curve.setData(*_finite(frequency, values))


class StructurePlot(Plot):
    """RMS difference of two wavefronts over their separation in the field."""

    def __init__(self) -> None:
        keys = (("with tilt", theme.ACCENT), ("without", theme.GREEN))
        super().__init__("Change (rad)", "separation in the field (mm)", keys)
        self.setToolTip(
            "RMS difference between the wavefronts at two field positions over their separation.\n"
            "The band contains all pairs. The isoplanatic patch ends where the difference reaches 1 rad.\n"
            "Tilt displaces the image; the rest blurs it."
        )
        self._scale = AdaptiveScale()
        self._curves = []
        for colour in (theme.GREEN, theme.ACCENT):
            ends = [pg.PlotCurveItem(pen=None) for _ in range(2)]
            band = pg.FillBetweenItem(*ends)
            theme.follow(self, partial(_tint, band, colour))
            self.view.addItem(band)
            self._curves.append((self.add_curve(colour), *ends))
        place = {"position": 0.04, "anchors": [(0, 0.95), (0, 0.95)]}
        limit = self.add_line(theme.AMBER, 0, 1.0, label="1 rad", labelOpts=place)
        theme.follow(self, lambda: limit.label.setColor(theme.AMBER))
        self.set_ranges((0, 1), (0, 1.5))

    def show_structure(self, found: Isoplanatism | None) -> None:
        if found is None:
            for item in chain.from_iterable(self._curves):
                item.setData([], [])
            return
        for items, curve in zip(self._curves, (found.curve_without_tilt, found.curve), strict=True):
            for item, values in zip(items, (curve.rms_rad, curve.least_rad, curve.most_rad), strict=True):
                item.setData(*_finite(np.append(0, curve.separation_m * 1e3), np.append(0, values)))
        most_rad = float(np.nanmax(found.curve.most_rad, initial=1.2))  # keeps the line at 1 rad visible
        farthest_mm = float(np.max(found.curve.separation_m, initial=1e-6)) * 1e3
        self.set_ranges((0, farthest_mm), (0, self._scale.follow(most_rad)))


def verdict(found: Isoplanatism) -> str:
    """Summarise the error of a single correction for the whole field and the isoplanatic patch."""
    if math.isnan(found.error_rad):
        return "No lenslet is valid over the whole field"
    patch = _patch(found.curve.patch_m)
    error = number(round(found.error_rad, _ERROR_DECIMALS), 2)
    return f"A single correction would leave {error} rad RMS. Isoplanatic patch: {patch}"


def _patch(patch_m: float) -> str:
    return f"{patch_m * 1e3:.2f} mm" if math.isfinite(patch_m) else "wider than the field"


def _tint(band: pg.FillBetweenItem, colour: QColor) -> None:
    brush = QColor(colour)
    brush.setAlpha(40)
    band.setBrush(brush)


def _finite(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    is_finite = np.isfinite(y)
    return x[is_finite], y[is_finite]
