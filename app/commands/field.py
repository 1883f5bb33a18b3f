"""`svwfs field`: coefficients of a wavefront over the field, with errors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options, terminal
from app.errors import InputError
from app.files import require_suffix, write_csv
from app.results.coefficients import (
    FIELD_BASIS,
    MAP_ACROSS,
    coefficient_sentences,
    field_dataset,
    field_figure,
    strongest,
    table_of,
)
from app.results.result_file import write_results
from app.results.sources import read_fit
from reconstruction.field_coefficients import fit_coefficients
from reconstruction.settings import PupilBasis


def field(
    source: options.RunOrResult,
    *,
    out: Annotated[Path, typer.Option(help="NetCDF file for maps and double Zernikes, or .csv for a table.")],
    basis: Annotated[
        PupilBasis, typer.Option(help="Modes of the pupil, see `svwfs docs field`; zernike gives double Zernikes, too.")
    ] = FIELD_BASIS,
    degree: Annotated[
        int | None, typer.Option(min=1, help="Highest degree of the pupil modes; as in the result if omitted.")
    ] = None,
    order: options.Order = "noll",
    field_order: Annotated[
        int | None, typer.Option(min=0, help="Highest order of double Zernikes over the field; all if omitted.")
    ] = None,
    positions: Annotated[int, typer.Option(min=1, max=501, help="Field positions along each side.")] = MAP_ACROSS,
    frame: options.Frame = 0,
    mode: Annotated[
        list[int] | None, typer.Option(metavar="N", help="Mode in the picture, repeatable; the strongest if omitted.")
    ] = None,
    plot: options.Plot = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Map the coefficients of a wavefront over the field, with errors.

    This is a full-field display: how much defocus, astigmatism, coma ... there is at each field position. The same
    wavefront is written as double Zernike coefficients in GalSim's convention. Error bars from a results file
    neglect correlations; of zonal wavefronts they are unknown. See `svwfs docs field`.

    Example: svwfs field run1 --out field.nc --plot field.png

    Example: svwfs field run1 --degree 4 --positions 5 --out table.csv

    Example: svwfs field result.nc --mode 5 --mode 6 --out field.nc --plot astigmatism.png
    """
    if field_order is not None and basis != "zernike":
        raise InputError(f"--field-order belongs to double Zernikes: leave it out with --basis {basis}")
    options.check_files(out, sources=[source], plot=plot, overwrite=overwrite)
    require_suffix(out, ".nc", ".csv")
    with terminal.analysing(source, out) as progress:
        progress("reconstructing the frame", 0.0)
        bench, fit = read_fit(source, frame)
        coefficients = fit_coefficients(fit, basis, degree)
        maps = field_dataset(
            coefficients, bench.sensor, bench.field, positions=positions, field_order=field_order, order=order
        )
        known = maps["mode"].values.tolist()
        for number in mode or ():
            if number not in known:
                raise InputError(f"--mode {number}: the {basis} modes of this result are {known[0]} ... {known[-1]}")
        progress("writing", 0.9)
        if out.suffix.lower() == ".csv":
            write_csv(out, *table_of(maps))
        else:
            write_results(out, maps, bench=bench, inputs={"source": source.name, "frame": str(frame)})
        options.draw(plot, lambda: field_figure(maps, mode or strongest(maps)), dpi=130)
    typer.echo("\n".join(coefficient_sentences(maps)))
    terminal.print_missing_lines(source)
