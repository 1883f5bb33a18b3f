"""`svwfs corrector`: what one corrector would leave at every distance, and its best command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal
from app.commands.layers import From
from app.errors import InputError
from app.files import require_suffix
from app.progress import between
from app.results.corrector import (
    DEFAULT,
    PHASE_FORMATS,
    compare_correctors,
    corrector_sentence,
    draw_corrector,
    write_phase,
)
from app.results.layers import ratio_at
from app.results.result_file import write_results
from app.results.sources import mean_wavefront, read_bench_of
from reconstruction.layers.corrector import Corrector, Influence


def corrector(
    source: options.RunOrResult,
    *,
    out: Annotated[Path, typer.Option(help="NetCDF file for residuals and command.")],
    modes: Annotated[Influence, typer.Option(help="Shapes that the corrector can take.")] = DEFAULT.influence,
    count: Annotated[int, typer.Option(min=2, help="Number of modes with piston, or of actuators.")] = DEFAULT.count,
    distance: Annotated[
        float | None, typer.Option(metavar="M", help="Distance of the corrector (m); the best one if omitted.")
    ] = None,
    origin: From = "lenslets",
    command: Annotated[
        Path | None,
        typer.Option(help="Phase map of the best command: .npy or .fits in rad, or .png wrapped at 2 pi, 8 bit."),
    ] = None,
    pixels: Annotated[int, typer.Option(min=2, max=8192, help="Pixels of the map's longer side.")] = 512,
    frames: options.Frames = None,
    plot: options.Plot = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Predict the residual behind one corrector at each conjugate distance.

    A corrector conjugate to some distance adds the same phase to every ray that meets it there. For each distance the
    best command is found, and its residual over the field. The mean wavefront of the frames is corrected. See
    `svwfs docs layers`.

    Example: svwfs corrector run1 --out corrector.nc --plot corrector.png

    Example: svwfs corrector result.nc --distance 0.195 --out c.nc --command slm.png --pixels 1024
    """
    try:
        shapes = Corrector(modes, count)
    except ValueError as error:
        raise InputError(f"--count: {error}") from error
    if command is not None:
        require_suffix(command, *PHASE_FORMATS)
    options.check_files(out, command, sources=[source], suffixes=(".nc",), plot=plot, overwrite=overwrite)
    with terminal.analysing(source, out) as progress:
        bench = read_bench_of(source)
        if distance is not None:
            ratio_at(distance, origin, bench)  # refuses a wrong one before the frames are read
        phase_at = mean_wavefront(source, bench, frames, between(progress, 0.0, 0.63))
        try:
            found, chosen = compare_correctors(phase_at, bench, shapes, at_m=distance, origin=origin)
        except ValueError as error:
            raise InputError(f"{source}: {error}") from error
        progress("writing", 0.9)
        write_results(out, found, bench=bench, inputs={"source": source.name})
        if command is not None:
            write_phase(command, chosen.phase_map(pixels)[2])
        options.draw(plot, lambda: draw_corrector(found))
    typer.echo(corrector_sentence(found))
    terminal.print_missing_lines(source)
