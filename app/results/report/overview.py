"""First page of a report: facts of the recording and the mean wavefront of every view."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import FigureBase, SubFigure
from numpy.typing import NDArray

from app.results.plot import draw_maps, place
from app.results.report.facts import facts
from app.results.report.layout import MARGIN_INCHES, PAGE_INCHES, QUIET, TITLE_INCHES, parts, write_title
from app.results.report.summary import Summary
from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.quality.isoplanatism import isoplanatism
from reconstruction.wavefront import peak_to_valley, rms

_LABEL_INCHES, _LINE_INCHES = 0.85, 0.18
_COLUMNS = 98  # characters of a line beside the labels
_MOST_VIEWS = 5  # along each axis; more would be too small
_LARGEST_POINTS = 8.0
_LETTER = 0.62  # width of a letter over its size, on average
_MAPS_PART = 0.82  # of the width; the rest is for the colour bar
_GREY_PERCENT = (0.5, 99.8)  # percentiles at the ends of the grey scale


def draw_overview(figure: FigureBase, summary: Summary) -> None:
    """Draw the page; without any wavefront, with images instead."""
    wrapped = [(label, textwrap.wrap(value, _COLUMNS)) for label, value in facts(summary)]
    lines = [(label * (at == 0), text) for label, texts in wrapped for at, text in enumerate(texts)]
    head = TITLE_INCHES + _LINE_INCHES * (len(lines) + 1)
    top, below = parts(figure, [head, PAGE_INCHES[1] - head])
    write_title(top, head, summary.name, _headline(summary))
    for index, (label, text) in enumerate(lines):
        y, left = 1 - (TITLE_INCHES + _LINE_INCHES * (index + 0.5)) / head, MARGIN_INCHES
        top.text(left / PAGE_INCHES[0], y, label, fontsize=8.5, color=QUIET, va="center")
        left += _LABEL_INCHES
        top.text(left / PAGE_INCHES[0], y, text, fontsize=8.5, va="center", parse_math=False)
    if (stats := summary.statistics) is None:
        _draw_images(below, summary)
    else:
        draw_views(below, stats.mean, stats.wavefront.field, f"mean wavefront of {summary.sampled_frames}")


def draw_views(
    figure: SubFigure, views: Floats, field: Field, title: str, *, limit: float = 0.0, with_places: bool = True
) -> None:
    """Draw the wavefronts of the views with RMS and PV, on a scale of +-`limit` rad, or up to the largest value."""
    rows, columns = (_some(count) for count in views.shape[:2])
    scale = limit or float(np.nanmax(np.abs(views), initial=0)) or 1.0
    captions = [
        [
            f"{place(field, row, column)}\n" * with_places
            + f"{rms(views[row, column]):.3f} / {peak_to_valley(views[row, column]):.2f}"
            for column in columns
        ]
        for row in rows
    ]
    hidden = views.shape[0] * views.shape[1] - len(rows) * len(columns)
    note = f"; {hidden} more views are not shown" * bool(hidden)
    figure.suptitle(f"{title}: RMS / PV (rad){note}", fontsize=10)
    colours = ("RdBu_r", Normalize(-scale, scale), "rad")
    draw_maps(figure, views[np.ix_(rows, columns)], captions, colours, fontsize=_fitting(captions, figure))


def _headline(summary: Summary) -> str:
    stats = summary.statistics
    if stats is None:
        return "no frame has a wavefront"
    of_views = rms(stats.mean)
    off_rad = isoplanatism(stats.wavefront).error_rad
    return (
        f"RMS {np.nanmin(of_views):.3f} ... {np.nanmax(of_views):.3f} rad over the views;"
        f" a single correction for the whole field would leave {off_rad:.2f} rad RMS, with its tilt"
    )


def _draw_images(figure: SubFigure, summary: Summary) -> None:
    """Draw the first frame and the reference, if any."""
    line, calibration = summary.lines[0], summary.calibration
    images: list[tuple[str, NDArray[Any]]] = [(f"frame {line.index}", summary.recording.pixels(line.index))]
    images += [] if calibration is None else [("reference", calibration.reference.mean)]
    for axis, (name, image) in zip(figure.subplots(1, len(images), squeeze=False)[0], images, strict=True):
        darkest, brightest = np.percentile(image, _GREY_PERCENT)
        axis.imshow(image, cmap="gray", vmin=darkest, vmax=brightest)
        axis.set_title(f"{name}: {image.min():.0f} ... {image.max():.0f} counts", fontsize=10)
        axis.set(xticks=[], yticks=[])


def _fitting(captions: list[list[str]], figure: SubFigure) -> float:
    """Font size at which neighbouring captions do not touch, points."""
    longest = max(len(line) for row in captions for caption in row for line in caption.splitlines())
    width_inches = _MAPS_PART * figure.bbox.width / figure.get_figure(root=True).dpi / len(captions[0])
    return min(_LARGEST_POINTS, 72 * width_inches / longest / _LETTER)


def _some(count: int) -> list[int]:
    """Indices of at most five evenly spaced views along an axis, from edge to edge."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, _MOST_VIEWS))})
