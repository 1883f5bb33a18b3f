"""Page of a report: the strongest Zernike coefficients over the field, with their errors."""

from matplotlib.figure import FigureBase

from app.results.field.dataset import coefficient_maps
from app.results.field.figure import draw_field, strongest
from app.results.report.layout import PAGE_INCHES, TITLE_INCHES, parts, write_title
from app.results.report.summary import Statistics, Summary
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import FieldCoefficients, ModalFit, field_coefficients

_POSITIONS = 21  # across the field
_MODES = 8


def over_field(stats: Statistics) -> FieldCoefficients | None:
    """Return the Zernike coefficients of the middle frame; None if its reconstruction has none."""
    try:
        return field_coefficients(ModalFit.of(stats.wavefront), "zernike")
    except ReconstructionError:
        return None


def draw_over_field(figure: FigureBase, summary: Summary, stats: Statistics, found: FieldCoefficients) -> None:
    """Draw the page."""
    title, maps = parts(figure, [TITLE_INCHES, PAGE_INCHES[1] - TITLE_INCHES])
    frame = int(stats.frames[(len(stats.frames) - 1) // 2])
    below = f"strongest Zernike coefficients of frame {frame} over the field (mm), and their errors (rad)"
    write_title(title, TITLE_INCHES, summary.name, below)
    dataset = coefficient_maps(found, stats.wavefront.field, _POSITIONS)
    draw_field(maps, dataset, strongest(dataset, _MODES))
