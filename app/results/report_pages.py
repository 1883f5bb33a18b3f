"""Pages of a report: facts and mean wavefronts, certainty, coefficients, comparison."""

import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

from app.plotting import Figure

# isort: split
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import SubFigure
from matplotlib.image import imsave
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

from app.files import atomic_write
from app.progress import Progress, between
from app.recording.reader import Recording
from app.results.coefficients import MAP_ACROSS, coefficient_maps, draw_field, evenly_spread, strongest
from app.results.comparison import Residual
from app.results.figures import draw_curves, draw_maps, place_of_view
from app.results.replay import change_of
from app.results.report_summary import Statistics, Summary, facts, summarise
from app.results.sources import mean_of_frames, read_fit
from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import ModalFit, fit_coefficients
from reconstruction.geometry import Field
from reconstruction.quality.isoplanatism import isoplanatism
from reconstruction.wavefront import peak_to_valley, rms

_PAGE_INCHES = (8.27, 11.69)  # A4
_TITLE_INCHES, _MARGIN_INCHES, _FOOT_INCHES = 1.0, 0.45, 0.3
_QUIET, _ACCENT = "0.4", "#1f4e79"
_LONGEST_TITLE = 55  # characters


def _page(
    title: str, sentence: str, shares: Sequence[float], head: float = _TITLE_INCHES
) -> tuple[Figure, list[SubFigure]]:
    """Return a page, and its head of a height, inches, with title and sentence, and shares of the rest."""
    figure = Figure(figsize=_PAGE_INCHES, layout=ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.08))  # inches
    heights = [head, *(share * (_PAGE_INCHES[1] - head) for share in shares), _FOOT_INCHES]
    top, *others, _ = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    left = _MARGIN_INCHES / _PAGE_INCHES[0]
    shown = textwrap.shorten(title, _LONGEST_TITLE, placeholder=" ...") or title[:_LONGEST_TITLE]
    top.text(left, 1 - 0.3 / head, shown, fontsize=17, weight="bold", color=_ACCENT, va="top", parse_math=False)
    wrapped = textwrap.fill(sentence, _COLUMNS)
    top.text(left, 1 - 0.63 / head, wrapped, fontsize=9.5, color=_QUIET, va="top", parse_math=False)
    return figure, [top, *others]


_LABEL_INCHES, _LINE_INCHES = 0.85, 0.18
_COLUMNS = 98  # characters of a line: of the sentence below the title, of the text beside the labels
_MOST_LINES = 4  # of a fact
_MOST_VIEWS = 5  # along each axis; more would be too small


def overview_page(summary: Summary) -> Figure:
    """Draw facts and mean wavefronts."""
    lines = [
        (label * (index == 0), line)
        for label, text in facts(summary)
        for index, line in enumerate(textwrap.wrap(text, _COLUMNS, max_lines=_MOST_LINES, placeholder=" ..."))
    ]
    head = _TITLE_INCHES + _LINE_INCHES * (len(lines) + 1)
    figure, (top, below) = _page(summary.name, _headline(summary), [1], head)
    for index, (label, text) in enumerate(lines):
        y, left = 1 - (_TITLE_INCHES + _LINE_INCHES * (index + 0.5)) / head, _MARGIN_INCHES
        top.text(left / _PAGE_INCHES[0], y, label, fontsize=8.5, color=_QUIET, va="center")
        left += _LABEL_INCHES
        top.text(left / _PAGE_INCHES[0], y, text, fontsize=8.5, va="center", parse_math=False)
    if (stats := summary.statistics) is not None:
        _draw_views(below, stats.mean, stats.wavefront.field, title=f"mean wavefront of {summary.sampled_frames}")
    return figure


def _draw_views(
    figure: SubFigure, views: Floats, field: Field, *, title: str, limit: float = 0.0, with_places: bool = True
) -> None:
    """Draw views (view_row, view_column, lenslet_row, lenslet_column), rad, with RMS and PV, up to `limit` if given."""
    # at most five evenly spaced views along an axis, from edge to edge
    rows, columns = (sorted({round(at) for at in np.linspace(0, n - 1, min(n, _MOST_VIEWS))}) for n in views.shape[:2])
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


_COLOURS = {
    LensletStatus.DARK: "#4d4d4d",
    LensletStatus.SATURATED: "#e69f00",
    LensletStatus.DIVERGED: "#cc3311",
    LensletStatus.LEFT_CELL: "#0077bb",
    LensletStatus.EXCLUDED: "#44aa99",
}
_VALID = np.array([0.91, 0.94, 0.91])  # red, green, blue


def certainty_page(summary: Summary, stats: Statistics) -> Figure:
    """Draw the RMS over time, lost lenslets and error bars, and curves over the field."""
    sentence = "stability, uncertainty and range of validity of the wavefront"
    figure, (_, trend, maps, curves) = _page(summary.name, sentence, [0.3, 0.36, 0.34])
    _draw_trend(trend.subplots(), summary, stats)
    lost, sigma = maps.subplots(1, 2)
    _draw_lost(lost, stats)
    image = sigma.imshow(stats.sigma, cmap="viridis", vmin=0)
    sigma.set(title="error bar of one frame", xticks=[], yticks=[], facecolor="0.6")
    maps.colorbar(image, ax=sigma, label="standard deviation (rad)", shrink=0.8)
    draw_curves(curves, stats.wavefront)
    for axis in (*trend.axes, *maps.axes, *curves.axes):
        axis.title.set_fontsize(8.5)
    return figure


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
    colours = np.where(np.isnan(stats.lost)[..., None], 1.0, _VALID)  # absent ones are white
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
    axis.set_title(f"{ever} of {np.isfinite(stats.lost).sum()} lenslets lost, {always} of them always")
    if handles:
        below = (0.5, -0.02)
        axis.legend(handles=handles, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=below, frameon=False)


_MODES = 8  # with the largest coefficients


def coefficients_page(summary: Summary, stats: Statistics) -> Figure | None:
    """Draw the strongest Zernike coefficients of the middle frame; None if its reconstruction has none."""
    try:
        return _coefficients(summary.name, stats.middle, ModalFit.of(stats.wavefront), stats.wavefront.field)
    except ReconstructionError:
        return None


def _coefficients(name: str, frame: int, fit: ModalFit, field: Field) -> Figure:
    found = fit_coefficients(fit, "zernike")
    sentence = f"strongest Zernike coefficients of frame {frame} over the field (mm), and their errors (rad)"
    figure, (_, maps) = _page(name, sentence, [1])
    dataset = coefficient_maps(found, field, *[evenly_spread(MAP_ACROSS)] * 2)
    draw_field(maps, dataset, strongest(dataset, _MODES))
    return figure


def comparison_page(residual: Residual) -> Figure:
    """Draw two wavefronts on the same colour scale, and their difference on its own."""
    title = f"{residual.name} and {residual.other_name}"
    figure, (_, above, below) = _page(title, residual.sentence, [0.42, 0.58])
    limit = float(np.nanmax(np.abs([residual.mean, residual.other_mean]), initial=0))
    ((own, other),) = above.subfigures(1, 2, squeeze=False)
    _draw_views(own, residual.mean, residual.field, title="the first", limit=limit, with_places=False)
    _draw_views(other, residual.other_mean, residual.field, title="the second", limit=limit, with_places=False)
    _draw_views(below, residual.views, residual.field, title="the first minus the second")
    return figure


_PNG_DPI = 110
_RECONSTRUCTED = 0.8  # share of the work that comes before the pages


def write_report(
    folder: Path,
    out: Path,
    *,
    frames: str | None = None,
    settings: tuple[str, ...] = (),
    progress: Progress = lambda *_: None,
) -> Summary:
    """Write the report of a recording, or of `frames` with other `settings`, as PDF or PNG; return what is in it."""
    reconstructing = between(progress, 0, _RECONSTRUCTED)
    summary = summarise(Recording(folder), frames, reconstructing, change=change_of(None, settings))
    progress("drawing the pages", _RECONSTRUCTED)
    pages = [overview_page(summary)]
    if (stats := summary.statistics) is not None:
        pages += filter(None, [certainty_page(summary, stats), coefficients_page(summary, stats)])
    with atomic_write(out) as temporary:
        write_pages(temporary, pages)
    return summary


def write_result_report(path: Path, out: Path) -> None:
    """Write the report of a results file: the mean wavefront of its frames, and coefficients of the first one."""
    (bench, fit), (_, views) = read_fit(path, 0), mean_of_frames(path)
    sensor = bench.sensor
    text = f"{bench.registration.method}, {bench.reconstruction.method}; {sensor.pupil.in_words or 'all lenslets'}"
    figure, (_, below) = _page(path.name, text, [1])
    _draw_views(below, views, bench.field, title="mean wavefront")
    with atomic_write(out) as temporary:
        write_pages(temporary, [figure, _coefficients(path.name, 0, fit, bench.field)])


def write_pages(path: Path, pages: Iterable[Figure]) -> None:
    """Write pages into a PDF or PNG."""
    if path.suffix.lower() != ".png":
        with PdfPages(path) as file:
            for page in pages:
                file.savefig(page)
        return
    images = []
    for page in pages:
        page.set_dpi(_PNG_DPI)
        canvas = FigureCanvasAgg(page)
        canvas.draw()  # type: ignore[no-untyped-call] # its stub lacks it
        images.append(np.asarray(canvas.buffer_rgba()))  # type: ignore[no-untyped-call] # its stub lacks it
    imsave(path, np.concatenate(images), dpi=_PNG_DPI)
