"""`svwfs layers`: at which distances the aberration originates, and its phase there."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal
from app.errors import InputError
from app.progress import between
from app.results.layers import COUNT, Origin, draw_layers, layer_sentences, layers_of_frame
from app.results.result_file import write_results

From = Annotated[
    Origin, typer.Option("--from", help="Where distances are measured from: lenslets, in the collimated beam, or mask.")
]
_MOST = 2  # layers


def layers(
    source: options.RunOrResult,
    *,
    out: Annotated[Path, typer.Option(help="NetCDF file for distances, phase maps and misfit.")],
    count: Annotated[int, typer.Option("--layers", min=1, max=_MOST, help="Number of layers to look for.")] = COUNT,
    distance: Annotated[
        list[float] | None, typer.Option(metavar="M", help="Known distance of a layer (m); repeat it for two layers.")
    ] = None,
    origin: From = "lenslets",
    frame: options.Frame = 0,
    plot: options.Plot = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Find at which distance the aberration originates.

    A thin layer shifts over the wavefront from one field position to the next, in proportion to its distance. The
    displacements of one frame give the distance of a layer, its phase map with error bars, and whether one layer, or
    two, explain them. A recording is more accurate than a results file, which has no reference. See
    `svwfs docs layers`.

    Example: svwfs layers run1 --out layers.nc --plot layers.png

    Example: svwfs layers run1 --layers 2 --from mask --out layers.nc
    """
    given = distance or []
    if len(given) > _MOST or len(set(given)) < len(given) or (count == _MOST and len(given) == 1):
        raise InputError("give the distance of one layer, or the two different distances of two layers, or none")
    options.check_files(out, sources=[source], suffixes=(".nc",), plot=plot, overwrite=overwrite)
    with terminal.analysing(source, out) as progress:
        bench, found = layers_of_frame(
            source, frame, count=count, distances_m=given, origin=origin, progress=between(progress, 0.0, 0.9)
        )
        progress("writing", 0.9)
        write_results(out, found, bench=bench, inputs={"source": source.name, "frame": str(frame)})
        options.draw(plot, lambda: draw_layers(found))
    typer.echo(f"frame {frame}: " + "\n".join(layer_sentences(found)))
    terminal.print_missing_lines(source)
