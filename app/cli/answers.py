"""Commands that answer questions about a measured wavefront: `svwfs layers`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from app.cli.options import OverwriteOption


def layers(
    source: Annotated[Path, typer.Argument(metavar="RUN|RESULT", help="Folder of a recording, or a results file.")],
    *,
    out: Annotated[Path, typer.Option(help="NetCDF file for distances, phase maps and misfit.")],
    count: Annotated[int, typer.Option("--layers", min=1, max=2, help="Number of layers to look for.")] = 1,
    distance: Annotated[
        list[float] | None, typer.Option(metavar="M", help="Known distance of a layer (m); repeat it for two layers.")
    ] = None,
    origin: Annotated[
        Literal["lenslets", "mask"],
        typer.Option("--from", help="Where distances are measured from: lenslets, in the collimated beam, or mask."),
    ] = "lenslets",
    frame: Annotated[int, typer.Option(min=0, help="Frame of the recording or results, counted from 0.")] = 0,
    plot: Annotated[Path | None, typer.Option(help="Picture of curve and maps: PNG, PDF or SVG.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Find at which distance the aberration originates.

    A thin layer shifts over the wavefront from one field position to the next, in proportion to its distance. The
    displacements of one frame give the distance of a layer, its phase map with error bars, and whether one layer, or
    two, explain them. A recording is more accurate than a results file, which no longer holds the reference. See
    docs/layers.md.

    Example: svwfs layers run1 --out layers.nc --plot layers.png

    Example: svwfs layers run1 --layers 2 --from mask --out layers.nc
    """
    from app.cli.tables import progress_bar
    from app.results.layers.run import find, summary

    with progress_bar() as progress:
        found = find(
            source,
            count=count,
            distances_m=tuple(distance or ()),
            origin=origin,
            frame=frame,
            out=out,
            plot=plot,
            overwrite=overwrite,
            progress=progress,
        )
    typer.echo("\n".join(summary(found)))
