"""What is made of, or into, frames in image files: `svwfs calibrate`, `simulate` and `reconstruct`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from app.cli.options import BenchOption, SetOption, load


def calibrate(
    reference: Annotated[Path, typer.Argument(help="A frame without the sample: TIFF or NPY.")],
    *,
    bench: BenchOption,
    out: Annotated[Path | None, typer.Option(help="Bench TOML to write, with the lattice in it.")] = None,
    dark: Annotated[Path | None, typer.Option(help="A frame with the light off.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of the frame with its lenslets to write: PNG, PDF or SVG.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file of --out.")] = False,
    setting: SetOption = None,
) -> None:
    """Find the lattice of lenslets in a reference: pitch, rotation, centre, what is lit. Without --out it only tells.

    Look at the picture of --plot before you trust it: every lit image should lie in the middle of its cell.
    """
    import json

    from app.cli.tables import progress_bar
    from app.commands.calibrate import as_numbers, check_out, differences, findings, write_calibrated
    from app.commands.calibrate import calibrate as run

    if out is not None:
        check_out(out, overwrite=overwrite)
    if plot is not None:
        from app.results.plot import check_plot_path

        check_plot_path(plot)
    loaded = load(bench, setting)
    with progress_bar() as progress:
        found = run(reference, dark=dark, bench=loaded, progress=progress)
    if plot is not None:
        from app.results.lattice_plot import plot_lattice

        plot_lattice(found.reference, found.survey, plot)
    if out is not None:
        write_calibrated(found, bench, out)
    if as_json:
        typer.echo(json.dumps(as_numbers(found)))
        return
    typer.echo("\n".join(findings(found)))
    for said in differences(found):
        typer.echo(f"note: {said}", err=True)


def simulate(
    *,
    bench: BenchOption,
    out: Annotated[Path, typer.Option(help="Folder for dark.tif, reference.tif, frame.tif and truth.nc.")],
    setting: SetOption = None,
    noise_free: Annotated[
        bool, typer.Option("--noise-free", help="Mean photons instead of the camera's counts.")
    ] = False,
) -> None:
    """Render what the simulated bench casts on its camera, and the true wavefronts."""
    from app.cli.tables import progress_bar
    from app.commands.simulate import simulate as run

    loaded = load(bench, setting)
    with progress_bar() as progress:
        run(loaded, out, noise_free=noise_free, progress=lambda fraction: progress("rendering", fraction))
    typer.echo(f"dark.tif, reference.tif, frame.tif and truth.nc are in {out}")


def reconstruct(
    frame: Annotated[Path, typer.Argument(help="The frame with the sample in: TIFF or NPY.")],
    *,
    reference: Annotated[Path, typer.Option(help="The frame without the sample.")],
    bench: BenchOption,
    out: Annotated[Path, typer.Option(help="NetCDF file to write.")],
    dark: Annotated[Path | None, typer.Option(help="A frame with the light off.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of the views to write: PNG, PDF or SVG.")] = None,
    refine: Annotated[
        int, typer.Option(min=0, max=100, help="Rounds of refinement by the forward model, at most.")
    ] = 0,
    setting: SetOption = None,
) -> None:
    """Reconstruct the wavefronts of one frame from image files."""
    from app.cli.tables import print_refinement, print_views, progress_bar
    from app.commands.reconstruct import reconstruct_files
    from app.results.dataset import result_dataset, write_results
    from app.results.plot import check_plot_path, plot_views

    if plot is not None:
        check_plot_path(plot)
    loaded = load(bench, setting)
    with progress_bar() if refine else nullcontext(lambda *_: None) as progress:
        found = reconstruct_files(frame, reference=reference, dark=dark, bench=loaded, refine=refine, progress=progress)
    inputs = {"frame": frame.name, "reference": reference.name, "dark": dark.name if dark else ""}
    dataset = result_dataset(found.wavefront, with_psf=True).assign_attrs(refinement_rounds=len(found.changes_rad))
    write_results(out, dataset, bench=loaded, inputs=inputs)
    if plot is not None:
        plot_views(found.wavefront, loaded.sensor, plot)
    print_views(found.wavefront)
    if refine:
        print_refinement(found.changes_rad)
