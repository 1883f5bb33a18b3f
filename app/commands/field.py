"""`svwfs field`: coefficients over the field of one frame, as maps, table and double Zernikes."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from app.commands import options, terminal
from app.errors import InputError


def field(
    source: options.Source,
    *,
    out: Annotated[
        Path, typer.Option(help="NetCDF file for maps and double Zernikes, or .csv for a table of field positions.")
    ],
    basis: Annotated[
        Literal["zernike", "legendre"],
        typer.Option(help="Modes: zernike over the pupil's inscribed circle, legendre over the whole lattice."),
    ] = "zernike",
    order: Annotated[
        int | None, typer.Option(min=1, help="Highest degree of the pupil modes; that of the result if omitted.")
    ] = None,
    field_order: Annotated[
        int | None, typer.Option(min=0, help="Highest order of double Zernikes over the field; all if omitted.")
    ] = None,
    positions: Annotated[int, typer.Option(min=1, max=501, help="Field positions along each side.")] = 21,
    frame: options.Frame = 0,
    mode: Annotated[
        list[int] | None,
        typer.Option(metavar="N", help="Mode in the picture, repeatable; the analysis.strongest if omitted."),
    ] = None,
    plot: options.Plot = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Map the coefficients of a wavefront over the field, with errors.

    This is a full-field display: how much defocus, astigmatism, coma ... there is at each field position. The same
    wavefront is written as double Zernike coefficients in GalSim's convention. Error bars from a results file
    neglect correlations. See docs/field.md.

    Example: svwfs field run1 --out field.nc --plot field.png

    Example: svwfs field run1 --order 4 --positions 5 --out table.csv

    Example: svwfs field result.nc --mode 5 --mode 6 --out field.nc --plot astigmatism.png
    """
    from app.files import write_csv
    from app.results import field_coefficients as analysis
    from app.results.figures import save_figure
    from app.results.result_file import write_results
    from app.results.sources import read_fit
    from reconstruction.errors import ReconstructionError
    from reconstruction.field_coefficients import field_coefficients
    from reconstruction.runtime.threads import one_blas_thread

    options.check_files(out, reads=options.files_of_sources(source), plot=plot, overwrite=overwrite)
    options.require_suffix(out, ".nc", ".csv")
    if field_order is not None and basis != "zernike":
        raise InputError("--field-order is that of double Zernikes: leave it out with --basis legendre")
    with terminal.progress_bar() as progress, one_blas_thread():
        progress("reconstructing the frame", 0.0)
        bench, fit = read_fit(source, frame)
        try:
            found = field_coefficients(fit, basis, order)
            maps = analysis.field_dataset(found, bench.sensor, bench.field, positions, field_order)
        except ReconstructionError as error:
            raise InputError(f"{source}: {error}") from error
        first, last = (int(maps["mode"].values[at]) for at in (0, -1))
        for number in mode or ():
            if not first <= number <= last:
                raise InputError(f"--mode {number}: the {basis} modes of this result are {first} ... {last}")
        progress("writing", 0.9)
        if out.suffix.lower() == ".csv":
            x_m = maps["x"].values
            write_csv(out, analysis.table_names(found), analysis.table_rows(found, bench.field, x_m, x_m))
        else:
            write_results(out, maps, bench=bench, inputs={"source": source.name, "frame": str(frame)})
        if plot is not None:
            save_figure(analysis.field_figure(maps, mode or analysis.strongest(maps)), plot, dpi=130)
    typer.echo("\n".join(analysis.field_sentences(maps)))
    terminal.print_version_notice(source)
