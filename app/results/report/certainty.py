"""Second page of a report: stability, uncertainty and range of validity of the wavefront."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import FigureBase
from matplotlib.patches import Patch

from app.results.plot import draw_structure, draw_transfer, place
from app.results.report.layout import PAGE_INCHES, TITLE_INCHES, parts, write_title
from app.results.report.summary import Statistics, Summary
from reconstruction.displacement import Outcome
from reconstruction.quality.image_quality import mtf
from reconstruction.quality.isoplanatism import isoplanatism

_COLOURS = {
    Outcome.DARK: "#4d4d4d",
    Outcome.SATURATED: "#e69f00",
    Outcome.DIVERGED: "#cc3311",
    Outcome.LEFT_CELL: "#0077bb",
    Outcome.OFF_CAMERA: "#aa4499",
    Outcome.EXCLUDED: "#44aa99",
}
_VALID = np.array([0.91, 0.94, 0.91])  # red, green, blue


def draw_certainty(figure: FigureBase, summary: Summary, stats: Statistics) -> None:
    """Draw the page."""
    rest = PAGE_INCHES[1] - TITLE_INCHES
    title, trend, maps, curves = parts(figure, [TITLE_INCHES, 0.3 * rest, 0.36 * rest, 0.34 * rest])
    write_title(title, TITLE_INCHES, summary.name, "stability, uncertainty and range of validity of the wavefront")
    _draw_trend(trend.subplots(), summary, stats)
    lost, sigma = maps.subplots(1, 2)
    _draw_lost(lost, stats)
    image = sigma.imshow(stats.sigma, cmap="viridis", vmin=0)
    sigma.set(title="error bar of one frame", xticks=[], yticks=[], facecolor="0.6")
    maps.colorbar(image, ax=sigma, label="standard deviation (rad)", shrink=0.8)
    field, views = stats.wavefront.field, stats.wavefront.views
    middle = field.view_rows // 2, field.view_columns // 2
    transfer, structure = curves.subplots(1, 2)
    draw_transfer(transfer, mtf(views[middle], summary.bench.sensor), place(field, *middle))
    draw_structure(structure, isoplanatism(stats.wavefront))
    for axis in (*trend.axes, *maps.axes, *curves.axes):
        axis.title.set_fontsize(8.5)


def _draw_trend(axis: Axes, summary: Summary, stats: Statistics) -> None:
    """Draw the live RMS of every frame, and with error bars the RMS of the sampled frames."""
    lines = summary.lines
    time_s = {line.index: line.host_time_s - lines[0].host_time_s for line in lines}
    live_rad = [np.nan if line.rms_rad is None else line.rms_rad for line in lines]
    axis.plot(list(time_s.values()), live_rad, "-", color="0.7", linewidth=1, label="as recorded", zorder=1)
    at_s = [time_s[index] for index in stats.frames.tolist()]
    name = f"{summary.sampled_frames} reconstructed again; bars: at most the error bar of one frame"
    axis.errorbar(at_s, stats.rms_rad, stats.rms_sigma_rad, fmt=".", capsize=2, linewidth=0.8, label=name, zorder=2)
    gaps_s = [time_s[line.index] for line in lines if line.lost]
    if gaps_s:
        axis.vlines(gaps_s, 0, 1, transform=axis.get_xaxis_transform(), color="#cc3311", lw=0.8, label="frames lost")
    failed_s = [time_s[line.index] for line in lines if line.problem]
    if failed_s:
        axis.plot(
            failed_s, [0.03] * len(failed_s), "x", transform=axis.get_xaxis_transform(), label="no live wavefront"
        )
    axis.set(title="RMS of the wavefront, mean over the views", xlabel="time since the first frame (s)", ylabel="rad")
    axis.ticklabel_format(useOffset=False)
    axis.margins(y=0.1)
    axis.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.22), frameon=False)


def _draw_lost(axis: Axes, stats: Statistics) -> None:
    """Draw the lenslets without a slope and the reason; the more frames, the stronger the colour."""
    colours = np.broadcast_to(_VALID, (*stats.lost.shape, 3)).copy()
    handles = []
    for outcome, colour in _COLOURS.items():
        where = stats.reason == outcome
        if where.any():
            part = 0.3 + 0.7 * stats.lost[where, None]
            colours[where] = part * np.array(to_rgb(colour)) + (1 - part) * _VALID
            handles.append(Patch(color=colour, label=f"{outcome.reason}: {where.sum()}"))
    axis.imshow(colours)
    rows, columns = stats.lost.shape
    axis.set_xticks(np.arange(columns + 1) - 0.5, labels=[], minor=True)
    axis.set_yticks(np.arange(rows + 1) - 0.5, labels=[], minor=True)
    axis.grid(which="minor", color="white", linewidth=0.6)
    axis.tick_params(which="both", length=0, labelbottom=False, labelleft=False)
    ever, always = int((stats.lost > 0).sum()), int((stats.lost == 1).sum())
    text = f"{ever} of {stats.lost.size} lenslets lost, {always} of them always" if ever else "no lenslet was lost"
    axis.set_title(text)
    if handles:
        axis.legend(
            handles=handles, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.02), frameon=False
        )
