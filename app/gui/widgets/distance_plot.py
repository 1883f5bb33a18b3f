"""Curves over the distance of a layer or a corrector, and the choice of the distances' origin."""

from typing import get_args

import numpy as np
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor

from app.gui.widgets import theme
from app.gui.widgets.buttons import Choice
from app.gui.widgets.plot import Plot
from app.results.layers import Origin, axis_label, shown_range_m
from reconstruction.arrays import Floats


def origin_choice() -> Choice:
    """Make a choice of where distances are measured from; its data are an `Origin`."""
    return Choice(
        "Where distances are measured from: lenslets, in the collimated beam, or mask.\n"
        "From the lenslets, negative distances lie behind them; there is no distance from the mask there.",
        [(f"from the {origin}", origin) for origin in get_args(Origin)],
    )


class DistancePlot(Plot):
    """A curve over distances, a dashed level, and a vertical line at each distance found."""

    def __init__(self, title: str, keys: tuple[tuple[str, QColor], ...], tool_tip: str, widest: str) -> None:
        super().__init__(title, axis_label("lenslets"), keys, widest)
        self.graphics.setMinimumHeight(3 * self.fontMetrics().height())  # the window fits small screens
        self.setToolTip(tool_tip)
        self.level = self.add_curve(theme.DIM, 1, Qt.PenStyle.DashLine)
        self.curve, self.marks = self.add_curve(theme.ACCENT), self.add_curve(theme.AMBER)

    def show_curve(self, distance_m: Floats, values: Floats, level: float, found_m: Floats, origin: Origin) -> None:
        """Show values over distances (distance,), m, on an axis about those that were found."""
        distance_mm = distance_m * 1e3
        low_mm, high_mm = (1e3 * end_m for end_m in shown_range_m(found_m, distance_m, origin))
        self.curve.setData(distance_mm, values)
        self.level.setData([low_mm, high_mm], [level, level])
        self.axes["bottom"].setLabel(axis_label(origin))
        shown = values[(low_mm <= distance_mm) & (distance_mm <= high_mm)]
        self.set_ranges((low_mm, high_mm), (0, 1.1 * max(float(shown.max()), level, 1e-6)))

    def mark(self, found_m: Floats) -> None:
        """Draw a line at each distance (found,), m, as high as the plot."""
        top = self.view.viewRange()[1][1]
        self.marks.setData(np.repeat(found_m * 1e3, 2), np.tile([0.0, top], found_m.size), connect="pairs")
