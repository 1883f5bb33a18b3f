"""`svwfs corrector`: what one corrector could do, over its distance, and its best command."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from app.commands import options, terminal
from app.errors import InputError


def corrector(
    source: options.Source,
    *,
    out: Annotated[Path, typer.Option(help="NetCDF file for residuals and command.")],
    influence: Annotated[
        Literal["legendre", "zernike", "actuators"], typer.Option("--modes", help="Shapes that the corrector can take.")
    ] = "zernike",
    count: Annotated[int, typer.Option(min=2, help="Number of modes with the piston, or of actuators.")] = 45,
    distance: Annotated[
        float | None, typer.Option(metavar="M", help="Distance of the corrector (m); the best one if omitted.")
    ] = None,
    origin: options.Origin = "lenslets",
    command: Annotated[
        Path | None,
        typer.Option(help="Phase map of the best command: .npy or .fits in rad, or .png wrapped at 2 pi, 8 bit."),
    ] = None,
    pixels: Annotated[int, typer.Option(min=2, max=8192, help="Pixels of the map's longer side.")] = 512,
    frames: options.Frames = None,
    plot: options.Plot = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Tell what one corrector could do, over its distance.

    A corrector conjugate to some distance adds the same phase to every ray that meets it there. For each distance its
    best command is found, and what it leaves over the field. The mean wavefront of the frames is corrected. See
    docs/layers.md.

    Example: svwfs corrector run1 --out corrector.nc --plot corrector.png

    Example: svwfs corrector result.nc --distance 0.195 --out c.nc --command slm.png --pixels 1024
    """
    from app.progress import between
    from app.results import corrector as analysis
    from app.results.figures import save_figure
    from app.results.layers import ratio_at
    from app.results.result_file import write_results
    from app.results.sources import mean_wavefront, read_bench_of
    from reconstruction.layers.corrector import Corrector

    try:
        shapes = Corrector(influence, count)
    except ValueError as error:
        raise InputError(f"--count: {error}") from error
    options.check_files(
        out, ".nc", reads=options.files_of_sources(source), plot=plot, more=command, overwrite=overwrite
    )
    if command is not None:
        options.require_suffix(command, *analysis.PHASE_FORMATS)
    with terminal.progress_bar() as progress:
        bench = read_bench_of(source)
        ratio = None if distance is None else ratio_at(distance, origin, bench)
        phase_at = mean_wavefront(source, bench, frames, between(progress, 0, 0.7))
        try:
            made = analysis.compare_correctors(phase_at, bench.sensor, bench.field, shapes, ratio)
        except ValueError as error:
            raise InputError(f"{source}: {error}") from error
        progress("writing", 0.9)
        found = analysis.correction_dataset(made, bench, origin)
        write_results(out, found, bench=bench, inputs={"source": source.name})
        if command is not None:
            analysis.write_phase(command, made.chosen.phase_map(pixels)[2])
        if plot is not None:
            save_figure(analysis.correction_figure(found), plot)
    typer.echo(analysis.correction_sentence(found))
    terminal.print_version_notice(source)
