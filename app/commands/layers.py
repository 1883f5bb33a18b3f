"""`svwfs layers`: distances and phase maps of the sample's layers, from one frame."""

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal
from app.errors import InputError

_MOST = 2


def layers(
    source: options.Source,
    *,
    out: Annotated[Path, typer.Option(help="NetCDF file for distances, phase maps and misfit.")],
    count: Annotated[int, typer.Option("--layers", min=1, max=_MOST, help="Number of layers to look for.")] = 1,
    distance: Annotated[
        list[float] | None, typer.Option(metavar="M", help="Known distance of a layer (m); repeat it for two layers.")
    ] = None,
    origin: options.Origin = "lenslets",
    frame: options.Frame = 0,
    plot: options.Plot = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Find at which distance the aberration originates.

    A thin layer shifts over the wavefront from one field position to the next, in proportion to its distance. The
    displacements of one frame give the distance of a layer, its phase map with error bars, and whether one layer, or
    two, explain them. A recording is more accurate than a results file, which no longer holds the reference. See
    docs/layers.md.

    Example: svwfs layers run1 --out layers.nc --plot layers.png

    Example: svwfs layers run1 --layers 2 --from mask --out layers.nc
    """
    from app.results.layers import layers_dataset, layers_figure, layers_sentences, ratio_at
    from app.results.result_file import write_results
    from app.results.sources import measured_frame
    from reconstruction.layers.layer_search import find_layers
    from reconstruction.runtime.threads import one_blas_thread

    distances_m = distance or []
    if len(distances_m) > _MOST:
        raise InputError("give at most two distances")
    if len(set(distances_m)) < len(distances_m):
        raise InputError("two layers need two different distances")
    if count == _MOST and len(distances_m) == 1:
        raise InputError("two layers need two distances, or none")
    options.check_files(out, ".nc", reads=options.files_of_sources(source), plot=plot, overwrite=overwrite)
    with terminal.progress_bar() as progress, one_blas_thread():
        progress("reconstructing the frame", 0.0)
        bench, equations = measured_frame(source, frame)
        ratios = tuple(ratio_at(distance_m, origin, bench) for distance_m in distances_m)
        progress("finding the layers", 0.3)
        found = layers_dataset(find_layers(equations, count, at=ratios), bench, origin)
        progress("writing", 0.9)
        write_results(out, found, bench=bench, inputs={"source": source.name, "frame": str(frame)})
        if plot is not None:
            from app.results.figures import save_figure

            save_figure(layers_figure(found), plot)
    typer.echo(f"frame {frame}: " + "\n".join(layers_sentences(found)))
    terminal.print_version_notice(source)
