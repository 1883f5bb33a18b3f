"""Figure of correctors: residual over the distance, and over the field."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from app.results.layers.dataset import axis_label, distance_in_words, shown_range_m


def correction_figure(found: xr.Dataset) -> Figure:
    """Return the figure: residual over the distance, and over the field."""
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    left.plot(found["distance"] * 1e3, found["residual"], color="#35739f", marker=".")
    origin, at_m = found.attrs["distances_from"], float(found["corrector_distance_m"])
    residual = float(found["corrector_residual"])
    label = f"{distance_in_words(at_m, np.nan, origin)}: {residual:.2g} rad"
    left.plot([at_m * 1e3], [residual], "o", color="#d1495b", label=label)
    uncorrected = float(found["uncorrected"])
    left.axhline(uncorrected, color="0.5", linewidth=0.8, linestyle="--", label=f"uncorrected: {uncorrected:.2g} rad")
    low_m, high_m = shown_range_m(found["corrector_distance_m"].values, found["distance"].values, origin)
    left.set(
        xlim=(1e3 * low_m, 1e3 * high_m),
        ylim=(0, None),
        xlabel=axis_label(origin),
        ylabel="residual over the field (rad RMS)",
        title=f"Best command of {found.attrs['shapes']} {found.attrs['influence']} shapes",
    )
    left.legend()
    shown = right.scatter(
        found["field_x"] * 1e3, found["field_y"] * 1e3, c=found["field_residual"], s=160, marker="s", vmin=0
    )
    right.set(xlabel="field x (mm)", ylabel="field y (mm)", aspect="equal", title="Residual (rad RMS)")
    right.invert_yaxis()  # +y down, as on the camera
    figure.colorbar(shown, ax=right)
    return figure
