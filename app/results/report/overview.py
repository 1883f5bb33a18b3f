"""The first page of a report: what the recording says of itself, and the mean wavefront of every view."""

from __future__ import annotations

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
_MOST_VIEWS = 5  # along each axis; more would be too small to see
_LARGEST_POINTS = 8.0
_LETTER = 0.62  # width of a letter over its size, on average
_MAPS_PART = 0.82  # of the width is for maps, the rest for their colour bar
_GREY_PERCENT = (0.5, 99.8)  # of the pixels lie within the grey scale


def draw_overview(figure: FigureBase, summary: Summary) -> None:
    """Draw the page; where no frame has a wavefront, it shows what the camera saw instead."""
    lines = [
        (label if first else "", text)
        for label, value in facts(summary)
        for first, text in _numbered(textwrap.wrap(value, _COLUMNS))
    ]
    head = TITLE_INCHES + _LINE_INCHES * (len(lines) + 1)
    top, below = parts(figure, [head, PAGE_INCHES[1] - head])
    write_title(top, head, summary.name, _headline(summary))
    for index, (label, text) in enumerate(lines):
        y, left = 1 - (TITLE_INCHES + _LINE_INCHES * (index + 0.5)) / head, MARGIN_INCHES
        top.text(left / PAGE_INCHES[0], y, label, fontsize=8.5, color=QUIET, va="center")
        left += _LABEL_INCHES
        top.text(left / PAGE_INCHES[0], y, text, fontsize=8.5, va="center", parse_math=False)
    if summary.found is None:
        _draw_images(below, summary)
    else:
        draw_views(
            below, summary.found.mean, summary.found.wavefront.field, f"mean wavefront of {summary.frames_looked_at}"
        )


def draw_views(
    figure: SubFigure, views: Floats, field: Field, title: str, *, limit: float = 0.0, with_places: bool = True
) -> None:
    """Draw the wavefronts of the views with RMS and PV, on a scale of +-`limit` rad, or of what there is."""
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
    found = summary.found
    if found is None:
        return "no frame has a wavefront"
    of_views = rms(found.mean)
    off_rad = isoplanatism(found.wavefront).error_rad
    return (
        f"RMS {np.nanmin(of_views):.3f} ... {np.nanmax(of_views):.3f} rad over the views;"
        f" one wavefront for the whole field would be off by {off_rad:.2f} rad RMS"
    )


def _draw_images(figure: SubFigure, summary: Summary) -> None:
    """Draw the first frame, and the reference if there is one."""
    line, calibration = summary.lines[0], summary.calibration
    images: list[tuple[str, NDArray[Any]]] = [(f"frame {line.index}", summary.recording.pixels(line.index))]
    images += [] if calibration is None else [("reference", calibration.reference.mean)]
    for axis, (name, image) in zip(figure.subplots(1, len(images), squeeze=False)[0], images, strict=True):
        darkest, brightest = np.percentile(image, _GREY_PERCENT)
        axis.imshow(image, cmap="gray", vmin=darkest, vmax=brightest)
        axis.set_title(f"{name}: {image.min():.0f} ... {image.max():.0f} counts", fontsize=10)
        axis.set(xticks=[], yticks=[])


def _fitting(captions: list[list[str]], figure: SubFigure) -> float:
    """Size of the letters, points, with which captions beside one another do not touch."""
    longest = max(len(line) for row in captions for caption in row for line in caption.splitlines())
    width_inches = _MAPS_PART * figure.bbox.width / figure.get_figure(root=True).dpi / len(captions[0])
    return min(_LARGEST_POINTS, 72 * width_inches / longest / _LETTER)


def _some(count: int) -> list[int]:
    """Indices of at most five views along an axis, from edge to edge, as evenly as it can be."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, _MOST_VIEWS))})


def _numbered(lines: list[str]) -> list[tuple[bool, str]]:
    return [(number == 0, line) for number, line in enumerate(lines)]
