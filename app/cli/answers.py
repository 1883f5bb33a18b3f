"""Commands that answer questions about a measured wavefront: `svwfs layers`, `corrector` and `field`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from app.cli.options import FramesOption, OverwriteOption
from app.errors import InputError

_OriginOption = Annotated[
    Literal["lenslets", "mask"],
    typer.Option("--from", help="Where distances are measured from: lenslets, in the collimated beam, or mask."),
]
_SourceArgument = Annotated[
    Path, typer.Argument(metavar="RUN|RESULT", help="Folder of a recording, or a results file.")
]
_PlotOption = Annotated[Path | None, typer.Option(help="Picture of the result: PNG, PDF or SVG.")]
_FrameOption = Annotated[int, typer.Option(min=0, help="Frame of the recording or results, counted from 0.")]


def layers(
    source: _SourceArgument,
    *,
    out: Annotated[Path, typer.Option(help="NetCDF file for distances, phase maps and misfit.")],
    count: Annotated[int, typer.Option("--layers", min=1, max=2, help="Number of layers to look for.")] = 1,
    distance: Annotated[
        list[float] | None, typer.Option(metavar="M", help="Known distance of a layer (m); repeat it for two layers.")
    ] = None,
    origin: _OriginOption = "lenslets",
    frame: _FrameOption = 0,
    plot: _PlotOption = None,
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
    from app.cli.tables import print_version_notice, progress_bar
    from app.results.layers_run import Plan, find, summary

    plan = Plan(
        source=source,
        frame=frame,
        count=count,
        distances_m=tuple(distance or ()),
        origin=origin,
        out=out,
        plot=plot,
        overwrite=overwrite,
    )
    with progress_bar() as progress:
        found = find(plan, progress)
    typer.echo(f"frame {frame}: " + "\n".join(summary(found)))
    print_version_notice(source)


def corrector(
    source: _SourceArgument,
    *,
    out: Annotated[Path, typer.Option(help="NetCDF file for residuals and command.")],
    influence: Annotated[
        Literal["legendre", "zernike", "actuators"], typer.Option("--modes", help="Shapes that the corrector can take.")
    ] = "zernike",
    count: Annotated[int, typer.Option(min=2, help="Number of modes with the piston, or of actuators.")] = 45,
    distance: Annotated[
        float | None, typer.Option(metavar="M", help="Distance of the corrector (m); the best one if omitted.")
    ] = None,
    origin: _OriginOption = "lenslets",
    command: Annotated[
        Path | None,
        typer.Option(help="Phase map of the best command: .npy or .fits in rad, or .png wrapped at 2 pi, 8 bit."),
    ] = None,
    pixels: Annotated[int, typer.Option(min=2, max=8192, help="Pixels of the map's longer side.")] = 512,
    frames: FramesOption = None,
    plot: _PlotOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Tell what one corrector could do, over its distance.

    A corrector conjugate to some distance adds the same phase to every ray that meets it there. For each distance its
    best command is found, and what it leaves over the field. The mean wavefront of the frames is corrected. See
    docs/layers.md.

    Example: svwfs corrector run1 --out corrector.nc --plot corrector.png

    Example: svwfs corrector result.nc --distance 0.195 --out c.nc --command slm.png --pixels 1024
    """
    from app.cli.tables import print_version_notice, progress_bar
    from app.results.corrector import in_words
    from app.results.corrector_run import Plan, correct
    from reconstruction.layers.corrector import Corrector

    try:
        shapes = Corrector(influence, count)
    except ValueError as error:
        raise InputError(f"--count: {error}") from error
    plan = Plan(
        source=source,
        frames=frames,
        corrector=shapes,
        distance_m=distance,
        origin=origin,
        out=out,
        plot=plot,
        command=command,
        pixels=pixels,
        overwrite=overwrite,
    )
    with progress_bar() as progress:
        found = correct(plan, progress)
    typer.echo(in_words(found))
    print_version_notice(source)


def field(
    source: _SourceArgument,
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
    frame: _FrameOption = 0,
    mode: Annotated[
        list[int] | None, typer.Option(metavar="N", help="Mode in the picture, repeatable; the strongest if omitted.")
    ] = None,
    plot: _PlotOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Map the coefficients of a wavefront over the field, with errors.

    This is a full-field display: how much defocus, astigmatism, coma ... there is at each field position. The same
    wavefront is written as double Zernike coefficients in GalSim's convention. Error bars from a results file
    neglect correlations. See docs/field.md.

    Example: svwfs field run1 --out field.nc --plot field.png

    Example: svwfs field run1 --order 4 --positions 5 --out table.csv

    Example: svwfs field result.nc --mode 5 --mode 6 --out field.nc --plot astigmatism.png
    """
    from app.cli.tables import print_version_notice, progress_bar
    from app.results.field_run import Plan, map_field, summary

    plan = Plan(
        source=source,
        frame=frame,
        basis=basis,
        order=order,
        field_order=field_order,
        positions=positions,
        modes=tuple(mode or ()),
        out=out,
        plot=plot,
        overwrite=overwrite,
    )
    with progress_bar() as progress:
        maps = map_field(plan, progress)
    typer.echo("\n".join(summary(maps)))
    print_version_notice(source)
