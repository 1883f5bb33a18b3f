"""The figure of the study: residual against what was varied, one panel for each sweep."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from app.evaluation.study.observations import Outcome

_COLUMNS = 2
_PANEL_INCHES = (7.6, 3.7)
# The same estimator looks the same in every panel.
_COLOURS = {
    "translation": "tab:gray",
    "affine": "tab:orange",
    "quadratic": "tab:blue",
    "cubic": "tab:green",
    "automatic": "tab:red",
}
_FEW_TIMES = 50  # so far a logarithmic axis shows its own numbers better than powers of ten
_MARKERS = "osD^vPX*<>"


def study_figure(outcomes: Sequence[Outcome]) -> Figure:
    """Draw the curves of all sweeps; what is asked for is a short black line."""
    columns = min(_COLUMNS, len(outcomes))
    rows = -(-len(outcomes) // columns)
    width, height = _PANEL_INCHES
    figure = Figure(figsize=(columns * width, rows * height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for outcome, panel in zip(outcomes, axes, strict=False):
        _draw(outcome, panel)
    for panel in axes[len(outcomes) :]:
        panel.set_axis_off()
    return figure


def _draw(outcome: Outcome, panel: Axes) -> None:
    positions = outcome.positions
    is_named = any(isinstance(at, str) for at in positions)
    place = {at: float(index) if is_named else float(outcome.shown(at)) for index, at in enumerate(positions)}
    curves = [each for each in outcome.curves if not any(word in each for word in outcome.sweep.left_out)]
    for index, curve in enumerate(curves):
        points = outcome.points(curve)
        x = np.array([place[at] for at in points])
        y = np.array([point.mean_rad for point in points.values()])
        spread = np.array([point.spread_rad for point in points.values()])
        colour = next((colour for name, colour in _COLOURS.items() if name in curve), None)
        style = "--" if "refined" in curve else ":" if is_named or "true" in curve else "-"
        panel.errorbar(
            x,
            y,
            np.minimum(spread, y * 0.9),  # a logarithmic axis has no place for what is below zero
            label=curve,
            color=colour,
            linestyle=style,
            marker=_MARKERS[index % len(_MARKERS)],
            markersize=4,
            linewidth=1,
            elinewidth=0.6,
            capsize=2,
        )
        asked = {place[at]: point.asked_rad for at, point in points.items() if np.isfinite(point.asked_rad)}
        panel.plot(list(asked), list(asked.values()), "k_", markersize=14)
    panel.set_yscale("log")
    if outcome.sweep.is_logarithmic:
        panel.set_xscale("log")
        if not is_named and max(place.values()) < _FEW_TIMES * min(place.values()):
            panel.set_xticks(list(place.values()), [f"{at:g}" for at in place.values()])
            panel.minorticks_off()
    if is_named:
        panel.set_xticks(list(place.values()), [str(at) for at in positions])
    panel.set_title(outcome.sweep.title, fontsize=10)
    panel.set_xlabel(outcome.sweep.axis)
    panel.set_ylabel("residual RMS (rad)")
    panel.grid(visible=True, which="both", linewidth=0.3)
    panel.legend(fontsize=6.5, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
