"""Commands on image files: `svwfs calibrate`, `simulate`, `reconstruct` and `deconvolve`."""

import math
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

import typer

from app.cli.command import FOLDER
from app.cli.options import BenchOption, FramesOption, OverwriteOption, SetOption, bench_file, load
from app.files import check_outputs, check_readable, check_suffix
from app.images import FORMATS
from app.progress import counted


def calibrate(
    reference: Annotated[Path, typer.Argument(help=f"Frame without the sample: {FORMATS}.")],
    *,
    bench: BenchOption,
    out: Annotated[Path | None, typer.Option(help="Bench TOML file to write, with the lattice.")] = None,
    dark: Annotated[Path | None, typer.Option(help="Frame with the light off.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of the frame with its lenslets: PNG, PDF or SVG.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")] = False,
    overwrite: OverwriteOption = False,
    setting: SetOption = None,
) -> None:
    """Find the lenslet lattice in a reference frame.

    The result is pitch, rotation, centre, and which lenslets are lit. Check the picture of --plot: every lit subimage
    should lie in the middle of its cell. Without --out the result is only printed.

    Example: svwfs calibrate reference.tif --bench paper_experiment --out bench.toml --plot lattice.png
    """
    import json

    from app.cli.tables import progress_bar
    from app.commands.calibrate import as_numbers, differences, summary, write_calibrated
    from app.commands.calibrate import calibrate as run

    loaded = load(bench, setting)
    _check_images(reference, dark)
    check_outputs((out, plot), inputs=(reference, dark, bench_file(bench), *loaded.files), overwrite=overwrite)
    check_suffix(out, ".toml")
    if plot is not None:
        from app.results.figures import check_plot_path

        check_plot_path(plot)
    with progress_bar() as progress:
        calibrated = run(reference, dark=dark, bench=loaded, progress=progress)
    if plot is not None:
        from app.results.figures import plot_lattice

        plot_lattice(calibrated.reference, calibrated.survey, plot)
    if out is not None:
        write_calibrated(calibrated, bench, out)
    if as_json:
        typer.echo(json.dumps(as_numbers(calibrated)))
        return
    typer.echo("\n".join(summary(calibrated)))
    for difference in differences(calibrated):
        typer.echo(f"note: {difference}", err=True)


def simulate(
    *,
    bench: BenchOption,
    out: Annotated[
        Path, typer.Option(metavar=FOLDER, help="Folder for dark.tif, reference.tif, frame.tif and truth.nc.")
    ],
    setting: SetOption = None,
    noise_free: Annotated[
        bool, typer.Option("--noise-free", help="Write mean photons instead of the camera's counts.")
    ] = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Simulate dark, reference and frame, with the true wavefronts.

    Example: svwfs simulate --bench paper_simulation --out simulated
    """
    from app.cli.tables import progress_bar
    from app.commands.simulate import files_of
    from app.commands.simulate import simulate as run

    loaded = load(bench, setting)
    check_outputs(files_of(out), inputs=(bench_file(bench), *loaded.files), overwrite=overwrite)
    with progress_bar() as progress:
        scintillation = run(
            loaded, out, noise_free=noise_free, progress=lambda fraction: progress("rendering", fraction)
        )
    typer.echo(f"dark.tif, reference.tif, frame.tif and truth.nc are in {out}")
    typer.echo(f"light at the lenslets: {100 * scintillation:.1f} % RMS from that without the sample")


def reconstruct(
    frame: Annotated[Path, typer.Argument(help=f"Frame with the sample: {FORMATS}.")],
    *,
    reference: Annotated[Path, typer.Option(help="Frame without the sample.")],
    bench: BenchOption,
    out: Annotated[Path, typer.Option(help="NetCDF file to write.")],
    dark: Annotated[Path | None, typer.Option(help="Frame with the light off.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of the views: PNG, PDF or SVG.")] = None,
    refine: Annotated[
        int, typer.Option(min=0, max=100, help="Maximum rounds of refinement with the forward model.")
    ] = 0,
    overwrite: OverwriteOption = False,
    setting: SetOption = None,
) -> None:
    """Reconstruct the wavefronts of one frame from image files.

    Example: svwfs reconstruct frame.tif --reference reference.tif --dark dark.tif --bench bench.toml --out result.nc
    """
    from app.cli.tables import print_quality, print_refinement, print_views, progress_bar
    from app.commands.reconstruct import reconstruct_files
    from app.results.dataset import result_dataset
    from app.results.figures import check_plot_path, plot_views
    from app.results.frame_tallies import QualityTally
    from app.results.result_file import write_results

    loaded = load(bench, setting)
    _check_images(frame, reference, dark)
    inputs = (frame, reference, dark, bench_file(bench), *loaded.files)
    check_outputs((out, plot), inputs=inputs, overwrite=overwrite)
    check_suffix(out, ".nc")
    if plot is not None:
        check_plot_path(plot)
    with progress_bar() if refine else nullcontext(lambda *_: None) as progress:
        reconstructed = reconstruct_files(
            frame, reference=reference, dark=dark, bench=loaded, refine=refine, progress=progress
        )
    names = {"frame": frame.name, "reference": reference.name, "dark": dark.name if dark else ""}
    dataset = result_dataset(reconstructed.wavefront, reconstructed.quality, with_psf=True).assign_attrs(
        refinement_rounds=len(reconstructed.changes_rad)
    )
    write_results(out, dataset, bench=reconstructed.bench, inputs=names)
    if plot is not None:
        plot_views(reconstructed.wavefront, plot)
    for note in reconstructed.notes:
        typer.echo(f"note: {note}", err=True)
    print_views(reconstructed.wavefront)
    if refine:
        print_refinement(reconstructed.changes_rad)
    tally = QualityTally()
    tally.take(reconstructed.quality)
    print_quality(tally)


def deconvolve(
    image: Annotated[Path, typer.Argument(help=f"Image of the sample, grey: {FORMATS}.")],
    *,
    source: Annotated[
        Path,
        typer.Option("--with", metavar="RESULT|RUN", help="Wavefronts: file of results, or folder of a recording."),
    ],
    out: Annotated[Path, typer.Option(help="TIFF file to write; its second page is 255 where the image is corrected.")],
    scale: Annotated[
        float | None, typer.Option(metavar="METRES", help="Size of a pixel in the field; same as imaging.pixel_m.")
    ] = None,
    imaging: Annotated[
        Path | None, typer.Option(metavar="TOML", help="File with a section [imaging], instead of the bench's.")
    ] = None,
    method: Annotated[
        Literal["richardson-lucy", "wiener"], typer.Option(help="wiener is faster and allows negative values.")
    ] = "richardson-lucy",
    iterations: Annotated[
        int, typer.Option(min=1, max=10_000, help="At most; it ends earlier when only noise is left.")
    ] = 50,
    frames: FramesOption = None,
    overwrite: OverwriteOption = False,
    setting: SetOption = None,
) -> None:
    """Deconvolve an image by the measured aberration of each field position.

    The image was taken through the same sample; the middle of the field is the middle of the image unless
    imaging.center_x_px and center_y_px say otherwise. Several frames are averaged. Pixels outside the measured field
    stay as they are. The noise is estimated from the image, or given by imaging.counts_per_electron and
    read_noise_counts. See docs/corrected_images.md.

    Example: svwfs deconvolve cells.tif --with result.nc --scale 2.5e-6 --out corrected.tif

    Example: svwfs deconvolve cells.tif --with run1 --frames 0:10 --imaging bench.toml --out corrected.tif

    Example: svwfs deconvolve cells.tif --with result.nc --scale 2.5e-6 --set imaging.rotation_rad=1.57 --out c.tif
    """
    from app.cli.tables import print_version_notice, progress_bar
    from app.commands.deconvolve import Plan
    from app.commands.deconvolve import deconvolve as run

    plan = Plan(
        image=image,
        source=source,
        out=out,
        imaging=imaging,
        settings=(*(() if scale is None else (f"imaging.pixel_m={scale!r}",)), *(setting or ())),
        frames=frames,
        method=method,
        iterations=iterations,
        overwrite=overwrite,
    )
    with progress_bar() as progress:
        made = run(plan, progress)
    known = "noise unknown" if math.isnan(made.chi_square) else f"chi-square {made.chi_square:.2f}"
    share = f"{100 * made.inside.mean():.0f} % of the pixels lie in the measured field"
    typer.echo(f"{counted(made.iterations, 'iteration')}, {known}; {share}; the image is in {out}")
    print_version_notice(source)


def _check_images(*images: Path | None) -> None:
    for image in filter(None, images):
        check_readable(image)
