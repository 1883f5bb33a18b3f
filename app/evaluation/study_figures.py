"""Figures of studies: a panel per sweep, a panel per quantity of trials, a row per method of a table."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from app.evaluation.study_kinds import ComparisonTable, PhotographStudy, Sweep, TrialStudy
from reconstruction.arrays import Floats
from reconstruction.wavefront import without_piston

_PANEL_INCHES = (7.6, 3.7)
# The same estimator looks the same in every panel.
_COLOURS = {
    "translation": "tab:gray",
    "affine": "tab:orange",
    "quadratic": "tab:blue",
    "cubic": "tab:green",
    "quartic": "tab:purple",
    "automatic": "tab:red",
}
_NARROW_RANGE = 50  # a logarithmic axis up to this ratio shows the positions instead of powers of ten
_MARKERS = "osD^vPX*<>"
_JITTER = 0.25  # rows, spreads the trials of a case


def sweep_figure(sweeps: Sequence[tuple[Sweep, xr.Dataset]]) -> Figure:
    """Draw the curves of all sweeps; short black lines are the limits."""
    columns = min(2, len(sweeps))
    lines = -(-len(sweeps) // columns)
    width, height = _PANEL_INCHES
    figure = Figure(figsize=(columns * width, lines * height), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for (sweep, data), panel in zip(sweeps, axes, strict=False):
        _draw_sweep(sweep, sweep.summary(data), panel)
    for panel in axes[len(sweeps) :]:
        panel.set_axis_off()
    return figure


def _draw_sweep(sweep: Sweep, summary: xr.Dataset, panel: Axes) -> None:
    positions = [sweep.shown(at) for at in summary["at"].values.tolist()]
    numbers = [at for at in positions if not isinstance(at, str)]
    is_named = not numbers
    all_x = np.arange(len(positions)) if is_named else np.array(numbers)
    curves = [each for each in summary["curve"].values.tolist() if not any(word in each for word in sweep.left_out)]
    for index, curve in enumerate(curves):
        points = summary.sel(curve=curve)
        measured = points["observations"].notnull().values
        x, y = all_x[measured], points["mean_rad"].values[measured]
        panel.errorbar(
            x,
            y,
            np.minimum(points["spread_rad"].values[measured], y * 0.9),  # bars stay above zero on the logarithmic axis
            label=curve,
            color=next((colour for name, colour in _COLOURS.items() if name in curve), None),
            linestyle="--" if "refined" in curve else ":" if is_named or "true" in curve else "-",
            marker=_MARKERS[index % len(_MARKERS)],
            markersize=4,
            linewidth=1,
            elinewidth=0.6,
            capsize=2,
        )
        panel.plot(all_x, points["asked_rad"].values, "k_", markersize=14)
    panel.set_yscale("log")
    if sweep.is_logarithmic:
        panel.set_xscale("log")
        if numbers and max(numbers) < _NARROW_RANGE * min(numbers):
            panel.set_xticks(numbers, [f"{at:g}" for at in numbers])
            panel.minorticks_off()
    if is_named:
        panel.set_xticks(all_x.tolist(), [str(at) for at in positions])
    panel.set_title(sweep.title, fontsize=10)
    panel.set_xlabel(sweep.axis)
    panel.set_ylabel("residual RMS (rad)")
    panel.grid(visible=True, which="both", linewidth=0.3)
    panel.legend(fontsize=6.5, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def trial_figure(study: TrialStudy, data: xr.Dataset) -> Figure:
    """Draw every trial as a point, a panel per quantity, a row per case; short black lines are the limits."""
    summary = study.summary(data)
    cases, quantities = data["case"].values.tolist(), data["quantity"].values.tolist()
    figure = Figure(figsize=(3.0 * (1 + len(quantities)), 1.2 + 0.26 * len(cases)), layout="constrained")
    panels = figure.subplots(1, len(quantities), sharey=True, squeeze=False)[0]
    row = np.arange(len(cases))
    for quantity, panel in zip(quantities, panels, strict=True):
        measured, limits = (
            data["measured"].sel(quantity=quantity).values,
            summary["asked"].sel(quantity=quantity).values,
        )
        spread = row[:, None] + np.linspace(-_JITTER, _JITTER, measured.shape[1])
        panel.plot(measured, spread, ".", color="tab:blue", markersize=4)
        panel.plot(limits, row, "k|", markersize=12)
        known = np.concatenate([measured.ravel(), limits])
        most = 1.05 * np.max(known, initial=0.0, where=np.isfinite(known)) or 1.0  # where all is 0
        panel.set_xlabel(quantity)
        panel.set_xlim(-0.03 * most, most)
        panel.grid(visible=True, linewidth=0.3)
    panels[0].set_yticks(row.tolist(), cases, fontsize=8)
    panels[0].invert_yaxis()
    figure.suptitle(study.title, fontsize=10)
    return figure


def table_figure(table: ComparisonTable, data: xr.Dataset) -> Figure:
    """Draw truth, reconstruction and residual of every method and light for its last seed, all on one colour scale."""
    known = data["seconds"].notnull().values  # (method, light, repeat)
    shown = [(*place, known[place].nonzero()[0][-1]) for place in np.ndindex(known.shape[:2]) if known[place].any()]
    means = table.summary(data)["mean_rad"].values
    wavefronts = [[data[kind].values[place] for kind in ("truth", "views")] for place in shown]
    limit = max(float(np.nanmax(abs(truth))) for truth, _ in wavefronts)
    scale = Normalize(-limit, limit)
    figure = Figure(figsize=(8.6, 2.4 * len(shown) + 0.6), layout="constrained")
    axes = figure.subplots(len(shown), 3, squeeze=False)
    for row, (method, light, _), (truth, views) in zip(axes, shown, wavefronts, strict=True):
        residual = f"residual, mean RMS {means[method, light]:.3f} rad"
        name = str(data["method"].values[method]) + ", real light" * (data["light"].values[light] == "real")
        titled = {table.compared_to: truth, name: views, residual: views - truth}
        for axis, (title, values) in zip(row, titled.items(), strict=True):
            axis.imshow(_mosaic(without_piston(values)), cmap="RdBu_r", norm=scale, interpolation="nearest")
            axis.set_title(title, fontsize=8)
            axis.set_axis_off()
    figure.colorbar(ScalarMappable(scale, "RdBu_r"), ax=axes, label="wavefront (rad)", shrink=0.6)
    return figure


def photograph_figure(study: PhotographStudy, data: xr.Dataset) -> Figure:
    """Draw the pictures of the first repeat, a row per object, a column per way; brightness has a gamma of 1/2."""
    objects, ways = data["object"].values.tolist(), data["way"].values.tolist()
    mean_db = study.summary(data)["mean_db"].values
    figure = Figure(figsize=(2.4 * len(ways), 2.65 * len(objects)), layout="constrained")
    axes = figure.subplots(len(objects), len(ways), squeeze=False)
    for (row, column), axis in np.ndenumerate(axes):
        picture = np.sqrt(np.clip(data["image"].values[row, column, 0], 0, 1))
        axis.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        known = f", {mean_db[row, column]:.1f} dB" if np.isfinite(mean_db[row, column]) else ""
        axis.set_title(f"{ways[column]}{known}", fontsize=8)
        axis.set_axis_off()
    return figure


def _mosaic(views: Floats) -> Floats:
    """All views side by side as they lie in the field, with a gap between them."""
    framed = np.pad(views, ((0, 0), (0, 0), (1, 1), (1, 1)), constant_values=np.nan)
    return np.block([list(row) for row in framed])
