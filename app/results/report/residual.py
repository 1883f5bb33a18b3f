"""Last page of a report: the difference from another recording of the same sample, as in the paper's Table 2."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import FigureBase

from app.errors import InputError
from app.results.replay.comparison import are_alike
from app.results.report.layout import PAGE_INCHES, TITLE_INCHES, parts, write_title
from app.results.report.overview import draw_views
from app.results.report.summary import Summary
from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.wavefront import rms, without_piston


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """Mean wavefronts of two recordings and their difference, rad.

    All are (view_row, view_column, lenslet_row, lenslet_column).
    """

    name: str
    other_name: str
    field: Field
    mean: Floats
    other_mean: Floats
    views: Floats  # difference without piston, where both are known

    @property
    def rms_rad(self) -> Floats:
        """RMS of the difference at each view, (view_row, view_column)."""
        return rms(self.views)

    @property
    def sentence(self) -> str:
        """The three numbers of the paper's Table 2."""
        values = self.rms_rad
        return (
            f"RMS of the difference at the views: least {np.nanmin(values):.3f}, most {np.nanmax(values):.3f},"
            f" mean {np.nanmean(values):.3f} rad"
        )


def residual_of(summary: Summary, other: Summary) -> Residual:
    """Subtract the mean wavefronts of `other`; `InputError` if they cannot be subtracted."""
    one, two = summary.statistics, other.statistics
    for each in (summary, other):
        if each.statistics is None:
            raise InputError(f"{each.recording.folder}: no frame has a wavefront: there is nothing to compare")
    assert one is not None and two is not None  # noqa: S101, PT018 - checked above
    folder, other_folder = summary.recording.folder, other.recording.folder
    if not are_alike(one.wavefront, two.wavefront):
        raise InputError(f"{other_folder}: has other views or lenslets than {folder}: nothing to compare")
    views = without_piston(one.mean - two.mean)
    if not np.isfinite(views).any():
        raise InputError(f"{other_folder}: has no lenslet in common with {folder}")
    return Residual(summary.name, other.name, one.wavefront.field, one.mean, two.mean, views)


def draw_comparison(figure: FigureBase, residual: Residual) -> None:
    """Draw the page; both recordings share a colour scale, the difference has its own."""
    rest = PAGE_INCHES[1] - TITLE_INCHES
    title, above, below = parts(figure, [TITLE_INCHES, 0.42 * rest, 0.58 * rest])
    write_title(title, TITLE_INCHES, f"{residual.name} beside {residual.other_name}", residual.sentence)
    limit = float(np.nanmax(np.abs([residual.mean, residual.other_mean]), initial=0))
    ((own, other),) = above.subfigures(1, 2, squeeze=False)
    draw_views(own, residual.mean, residual.field, "the first", limit=limit, with_places=False)
    draw_views(other, residual.other_mean, residual.field, "the second", limit=limit, with_places=False)
    draw_views(below, residual.views, residual.field, "the first minus the second")
