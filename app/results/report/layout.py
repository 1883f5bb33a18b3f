"""Page size, title and vertical parts of the report's pages."""

import textwrap
from collections.abc import Callable, Sequence

from matplotlib.figure import Figure, FigureBase, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine

Page = Callable[[FigureBase], None]  # draws a page into a figure or a part of one

PAGE_INCHES = (8.27, 11.69)  # A4
TITLE_INCHES = 0.85
MARGIN_INCHES = 0.45
QUIET = "0.4"
_FOOT_INCHES = 0.3
_ACCENT = "#1f4e79"
_LONGEST_TITLE = 55  # characters


def one_page(page: Page) -> Figure:
    """Return a figure with one page."""
    figure = Figure(figsize=PAGE_INCHES, layout=_spaced())
    page(figure)
    return figure


def all_pages(pages: Sequence[Page]) -> Figure:
    """Return a figure with all pages, one below the other."""
    width, height = PAGE_INCHES
    figure = Figure(figsize=(width, height * len(pages)), layout=_spaced())
    for page, part in zip(pages, figure.subfigures(len(pages), 1, squeeze=False)[:, 0], strict=True):
        page(part)
    return figure


def parts(figure: FigureBase, heights: Sequence[float]) -> list[SubFigure]:
    """Divide a page into parts of these heights, one below the other, above an empty margin."""
    ratios = [*heights, _FOOT_INCHES]
    return list(figure.subfigures(len(ratios), 1, squeeze=False, height_ratios=ratios)[:-1, 0])


def write_title(figure: SubFigure, height: float, title: str, below: str) -> None:
    """Write a title and a sentence at the top of a part of this height, inches."""
    left = MARGIN_INCHES / PAGE_INCHES[0]
    shown = textwrap.shorten(title, _LONGEST_TITLE, placeholder=" ...") or title[:_LONGEST_TITLE]
    figure.text(left, 1 - 0.3 / height, shown, fontsize=17, weight="bold", color=_ACCENT, va="top", parse_math=False)
    figure.text(left, 1 - 0.63 / height, below, fontsize=9.5, color=QUIET, va="top", parse_math=False)


def _spaced() -> ConstrainedLayoutEngine:
    return ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.08)  # inches
