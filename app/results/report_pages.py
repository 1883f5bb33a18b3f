"""Pages of a report: facts and mean wavefronts, certainty, coefficients, comparison."""

import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure, FigureBase, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from numpy.typing import NDArray

from app.files import atomic_write
from app.progress import Progress, between, part
from app.recording.reader import Recording
from app.results.coefficients import MAP_ACROSS, coefficient_maps, draw_field, evenly_spread, strongest
from app.results.figures import draw_curves, draw_maps, place_of_view, show_grey
from app.results.replay import change_of
from app.results.report_summary import Fact, Residual, Statistics, Summary, facts, residual_of, summarise
from reconstruction.arrays import Floats
from reconstruction.displacement import Outcome
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import FieldCoefficients, ModalFit, fit_coefficients
from reconstruction.geometry import Field
from reconstruction.quality.isoplanatism import isoplanatism
from reconstruction.wavefront import peak_to_valley, rms

Page = Callable[[FigureBase], None]  # draws a page into a figure or a part of one

PAGE_INCHES = (8.27, 11.69)  # A4
TITLE_INCHES = 1.0
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


def _page_parts(
    figure: FigureBase, title: str, sentence: str, shares: Sequence[float], *, head: float = TITLE_INCHES
) -> list[SubFigure]:
    """Divide a page into a head of this height, inches, and shares of the rest, above an empty margin.

    Title and sentence are at the top of the head.
    """
    heights = [head, *(share * (PAGE_INCHES[1] - head) for share in shares), _FOOT_INCHES]
    top, *others, _ = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    left = MARGIN_INCHES / PAGE_INCHES[0]
    shown = textwrap.shorten(title, _LONGEST_TITLE, placeholder=" ...") or title[:_LONGEST_TITLE]
    top.text(left, 1 - 0.3 / head, shown, fontsize=17, weight="bold", color=_ACCENT, va="top", parse_math=False)
    wrapped = textwrap.fill(sentence, _COLUMNS)
    top.text(left, 1 - 0.63 / head, wrapped, fontsize=9.5, color=QUIET, va="top", parse_math=False)
    return [top, *others]


def _spaced() -> ConstrainedLayoutEngine:
    return ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.08)  # inches


_LABEL_INCHES, _LINE_INCHES = 0.85, 0.18
_COLUMNS = 98  # characters of a line: of the sentence below the title, of the text beside the labels
_MOST_LINES = 32  # of all facts; more would leave no place for the wavefronts
_MOST_VIEWS = 5  # along each axis; more would be too small


def draw_overview(figure: FigureBase, summary: Summary) -> None:
    """Draw the page; without any wavefront, with images instead."""
    lines = _lines(facts(summary))
    head = TITLE_INCHES + _LINE_INCHES * (len(lines) + 1)
    top, below = _page_parts(figure, summary.name, _headline(summary), [1], head=head)
    for index, (label, text) in enumerate(lines):
        y, left = 1 - (TITLE_INCHES + _LINE_INCHES * (index + 0.5)) / head, MARGIN_INCHES
        top.text(left / PAGE_INCHES[0], y, label, fontsize=8.5, color=QUIET, va="center")
        left += _LABEL_INCHES
        top.text(left / PAGE_INCHES[0], y, text, fontsize=8.5, va="center", parse_math=False)
    if (stats := summary.statistics) is None:
        _draw_images(below, summary)
    else:
        draw_views(below, stats.mean, stats.wavefront.field, title=f"mean wavefront of {summary.sampled_frames}")


def _lines(said: list[Fact]) -> list[tuple[str, str]]:
    """Wrap facts, at most a page's share of them: a damaged recording may have a text of any length."""
    for most in (12, 6, 3, 1):  # lines of each
        wrapped = [(name, textwrap.wrap(text, _COLUMNS, max_lines=most, placeholder=" ...")) for name, text in said]
        if sum(len(texts) for _, texts in wrapped) <= _MOST_LINES:
            break
    return [(label * (at == 0), text) for label, texts in wrapped for at, text in enumerate(texts)]


def draw_views(
    figure: SubFigure, views: Floats, field: Field, *, title: str, limit: float = 0.0, with_places: bool = True
) -> None:
    """Draw the views with RMS and PV, on a scale of +-`limit` rad, or up to the largest value.

    `views` are in rad, (view_row, view_column, lenslet_row, lenslet_column).
    """
    rows, columns = (_some(count) for count in views.shape[:2])
    scale = limit or float(np.nanmax(np.abs(views), initial=0)) or 1.0

    def caption(row: int, column: int) -> str:
        view = rows[row], columns[column]
        place = f"{place_of_view(field, *view)}\n" * with_places
        return f"{place}{rms(views[view]):.3f} / {peak_to_valley(views[view]):.2f}"

    hidden = views.shape[0] * views.shape[1] - len(rows) * len(columns)
    note = f"; {hidden} more views are not shown" * bool(hidden)
    figure.suptitle(f"{title}: RMS / PV (rad){note}", fontsize=10)
    colours = ("RdBu_r", Normalize(-scale, scale), "rad")
    draw_maps(figure, views[np.ix_(rows, columns)], caption, colours)


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
    line, calibration = summary.lines[0], summary.calibration
    images: list[tuple[str, NDArray[Any]]] = [(f"frame {line.index}", summary.recording.pixels(line.index))]
    images += [] if calibration is None else [("reference", calibration.reference.mean)]
    for axis, (name, image) in zip(figure.subplots(1, len(images), squeeze=False)[0], images, strict=True):
        show_grey(axis, image)
        axis.set_title(f"{name}: {image.min():.0f} ... {image.max():.0f} counts", fontsize=10)
        axis.set(xticks=[], yticks=[])


def _some(count: int) -> list[int]:
    """Indices of at most five evenly spaced views along an axis, from edge to edge."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, _MOST_VIEWS))})


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
    sentence = "stability, uncertainty and range of validity of the wavefront"
    _, trend, maps, curves = _page_parts(figure, summary.name, sentence, [0.3, 0.36, 0.34])
    _draw_trend(trend.subplots(), summary, stats)
    lost, sigma = maps.subplots(1, 2)
    _draw_lost(lost, stats)
    image = sigma.imshow(stats.sigma, cmap="viridis", vmin=0)
    sigma.set(title="error bar of one frame", xticks=[], yticks=[], facecolor="0.6")
    maps.colorbar(image, ax=sigma, label="standard deviation (rad)", shrink=0.8)
    draw_curves(curves, stats.wavefront)
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
        low = axis.get_xaxis_transform()
        axis.plot(failed_s, [0.03] * len(failed_s), "x", transform=low, label="no live wavefront")
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
            share = 0.3 + 0.7 * stats.lost[where, None]
            colours[where] = share * np.array(to_rgb(colour)) + (1 - share) * _VALID
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
        below = (0.5, -0.02)
        axis.legend(handles=handles, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=below, frameon=False)


_MODES = 8  # with the largest coefficients


def over_field(stats: Statistics) -> FieldCoefficients | None:
    """Return the Zernike coefficients of the middle frame; None if its reconstruction has none."""
    try:
        return fit_coefficients(ModalFit.of(stats.wavefront), "zernike")
    except ReconstructionError:
        return None


def draw_over_field(figure: FigureBase, summary: Summary, stats: Statistics, found: FieldCoefficients) -> None:
    """Draw the page."""
    sentence = f"strongest Zernike coefficients of frame {stats.middle} over the field (mm), and their errors (rad)"
    _, maps = _page_parts(figure, summary.name, sentence, [1])
    dataset = coefficient_maps(found, stats.wavefront.field, *[evenly_spread(MAP_ACROSS)] * 2)
    draw_field(maps, dataset, strongest(dataset, _MODES))


def draw_comparison(figure: FigureBase, residual: Residual) -> None:
    """Draw the page; both recordings share a colour scale, the difference has its own."""
    title = f"{residual.name} beside {residual.other_name}"
    _, above, below = _page_parts(figure, title, residual.sentence, [0.42, 0.58])
    limit = float(np.nanmax(np.abs([residual.mean, residual.other_mean]), initial=0))
    ((own, other),) = above.subfigures(1, 2, squeeze=False)
    draw_views(own, residual.mean, residual.field, title="the first", limit=limit, with_places=False)
    draw_views(other, residual.other_mean, residual.field, title="the second", limit=limit, with_places=False)
    draw_views(below, residual.views, residual.field, title="the first minus the second")


_PNG_DPI = 110
_RECONSTRUCTED = 0.8  # share of the work that comes before the pages


def write_report(
    folder: Path,
    out: Path,
    *,
    frames: str | None = None,
    settings: tuple[str, ...] = (),
    beside: Path | None = None,
    progress: Progress = lambda *_: None,
) -> tuple[Summary, Residual | None]:
    """Write the report of a recording as PDF or PNG; return what is in it.

    `frames` and changed `settings` are those of the first recording; `beside` is subtracted from it.
    """
    recordings = [Recording(each) for each in (folder, beside) if each is not None]
    parts = [part(between(progress, 0, _RECONSTRUCTED), index, len(recordings)) for index in range(len(recordings))]
    summary = summarise(recordings[0], frames, parts[0], change=change_of(None, settings))
    residual = None if beside is None else residual_of(summary, summarise(recordings[1], None, parts[1]))
    _write_pages(out, summary, residual, between(progress, _RECONSTRUCTED, 1))
    return summary, residual


def _write_pages(out: Path, summary: Summary, residual: Residual | None, progress: Progress) -> None:
    """Write the pages as PDF, or one below the other as PNG (atomic)."""
    drawn: list[Page] = [partial(draw_overview, summary=summary)]
    if (stats := summary.statistics) is not None:
        drawn.append(partial(draw_certainty, summary=summary, stats=stats))
        if (found := over_field(stats)) is not None:
            drawn.append(partial(draw_over_field, summary=summary, stats=stats, found=found))
    if residual is not None:
        drawn.append(partial(draw_comparison, residual=residual))
    with atomic_write(out) as temporary:
        if out.suffix.lower() == ".png":
            width, height = PAGE_INCHES
            whole = Figure(figsize=(width, height * len(drawn)), layout=_spaced())
            for page, place in zip(drawn, whole.subfigures(len(drawn), 1, squeeze=False)[:, 0], strict=True):
                page(place)
            whole.savefig(temporary, dpi=_PNG_DPI)
            return
        with PdfPages(temporary) as file:
            for index, page in enumerate(drawn):
                progress("drawing the pages", index / len(drawn))
                file.savefig(one_page(page))
