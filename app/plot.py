"""A picture of a result: every view's wavefront on one colour scale, with RMS and PV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from app.errors import InputError
from app.files import appearing_whole
from reconstruction.geometry import Field
from reconstruction.wavefront import Wavefront, peak_to_valley, rms


def check_plot_path(path: Path) -> None:
    """Raise `InputError`, before any work is done, if no picture can be written under that name."""
    formats = sorted(Figure().canvas.get_supported_filetypes())
    if path.suffix.lstrip(".").lower() not in formats:
        raise InputError(f"{path}: give a picture's name that ends in one of {', '.join(formats)}")


def plot_views(wavefront: Wavefront, path: Path) -> None:
    """Draw the views as they lie in the field, +x to the right and +y down as on the camera, into an image file."""
    with appearing_whole(path) as temporary:
        views_figure(wavefront).savefig(temporary, dpi=150)


def views_figure(wavefront: Wavefront) -> Figure:
    """The figure of `plot_views`."""
    views, field = wavefront.views, wavefront.field
    limit = float(np.nanmax(np.abs(views)))
    figure = Figure(figsize=(2.2 * field.view_columns + 1.2, 2.5 * field.view_rows + 0.4), layout="constrained")
    axes = figure.subplots(field.view_rows, field.view_columns, squeeze=False)
    scale = Normalize(-limit, limit)
    for (row, column), axis in np.ndenumerate(axes):
        axis.imshow(views[row, column], cmap="RdBu_r", norm=scale)
        axis.set_title(_caption(wavefront, field, row, column), fontsize=8)
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_facecolor("0.6")  # lost lenslets
    figure.colorbar(ScalarMappable(scale, "RdBu_r"), ax=axes, label="wavefront (rad)", shrink=0.8)
    return figure


def _caption(wavefront: Wavefront, field: Field, row: int, column: int) -> str:
    view = wavefront.views[row, column]
    place = f"({field.view_x_m[column] * 1e3:+.2f}, {field.view_y_m[row] * 1e3:+.2f}) mm"
    return f"{place}\nRMS {rms(view):.3f}  PV {peak_to_valley(view):.2f} rad"
