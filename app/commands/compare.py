"""`svwfs compare`: the difference of two recordings or results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal


def compare(
    source: options.RunOrResult,
    other: Annotated[Path, typer.Argument(metavar="RUN|RESULT", help="Recording or results file to subtract.")],
    *,
    plot: options.Plot = None,
    remove: options.Remove = None,
    setting: options.Set = None,
    frames: options.Frames = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Compare the mean wavefronts of two recordings or results, view by view.

    RMS and PV are those of the first minus the second, where both know the wavefront. --set and --frames are for the
    first, a recording that is reconstructed again: so methods are compared, as in the paper's table of the square with
    the stars. Modes removed from either are removed from the difference. --plot draws both and the difference.

    Example: svwfs compare before.nc after.nc --remove tilt,defocus --plot difference.png

    Example: svwfs compare square stars --set registration.warp=affine --plot compared.pdf
    """
    options.check_files(sources=[source, other], plot=plot, overwrite=overwrite)
    from app.results.comparison import residual_of
    from app.results.figures import place_of_view
    from app.results.replay import change_of
    from app.results.report_pages import comparison_page
    from app.results.sources import removed_from
    from app.results.zernike_table import modes_named, view_sentence

    settings = tuple(setting or ())
    removed = modes_named(without := ",".join(filter(None, (remove, removed_from(source), removed_from(other)))))
    with terminal.analysing(source, plot or source) as progress:
        change = change_of(None, settings) if settings else None
        found = residual_of(source, other, frames=frames, change=change, removed=removed, progress=progress)
        options.draw(plot, lambda: comparison_page(found))
    names = dict.fromkeys(name.strip().lower() for name in without.split(","))
    which = f", without {', '.join(names)}" if without else ""
    title = f"RMS (rad) of {found.name} minus {found.other_name}{which}, means of their frames"
    terminal.print_by_view(found.field, title, ((f"{value:.3f}" for value in row) for row in found.rms_rad))
    view = found.field.view_rows // 2, found.field.view_columns // 2
    place = place_of_view(found.field, *view)
    for name, views in ((found.name, found.mean), (found.other_name, found.other_mean), ("difference", found.views)):
        terminal.print_sentence(f"{name} at {place}: {view_sentence(views[view], found.sensor)}")
    terminal.print_sentence(found.sentence)
    for each in (source, other):
        terminal.print_missing_lines(each)
