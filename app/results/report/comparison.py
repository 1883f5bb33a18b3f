"""The last page of a report: the mean wavefronts beside another recording's, and what is left of them."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import FigureBase

from app.results.report.layout import PAGE_INCHES, TITLE_INCHES, parts, write_title
from app.results.report.overview import draw_views
from app.results.report.residual import Residual


def draw_comparison(figure: FigureBase, residual: Residual) -> None:
    """Draw the page; both recordings are on one colour scale, what is left has its own."""
    rest = PAGE_INCHES[1] - TITLE_INCHES
    title, above, below = parts(figure, [TITLE_INCHES, 0.42 * rest, 0.58 * rest])
    write_title(title, TITLE_INCHES, f"{residual.name} beside {residual.other_name}", residual.sentence)
    limit = float(np.nanmax(np.abs([residual.mean, residual.other_mean]), initial=0))
    ((own, other),) = above.subfigures(1, 2, squeeze=False)
    draw_views(own, residual.mean, residual.field, "the first", limit=limit, with_places=False)
    draw_views(other, residual.other_mean, residual.field, "the second", limit=limit, with_places=False)
    draw_views(below, residual.views, residual.field, "the first minus the second")
