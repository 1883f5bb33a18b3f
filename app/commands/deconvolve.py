"""`svwfs deconvolve`: an image of the sample without the aberration that was measured through it."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from app.commands import options, terminal
from app.errors import InputError, Interrupted
from app.files import atomic_write, in_words
from app.images import FORMATS
from app.progress import Progress, counted

if TYPE_CHECKING:
    from app.bench.config import Bench
    from reconstruction.arrays import Counts
    from reconstruction.deconvolution.corrected_image import CorrectedImage, PhaseAt, RestorationMethod

_READING = 0.1  # share of the work


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
    frames: options.Frames = None,
    overwrite: options.Overwrite = False,
    setting: options.Set = None,
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
    import math

    from app.images import read_image
    from app.progress import between
    from app.results.sources import mean_wavefront, read_bench_of

    settings = [*_section(imaging), *(() if scale is None else (f"imaging.pixel_m={scale!r}",)), *(setting or ())]
    loaded = read_bench_of(source, tuple(settings))
    options.check_images(image)
    reads = [image, imaging, *options.files_of_sources(source), *loaded.files]
    options.check_files(out, ".tif", ".tiff", reads=reads, overwrite=overwrite)
    pixels = read_image(image)
    try:
        with terminal.progress_bar() as progress:
            phase_at = mean_wavefront(source, loaded, frames, between(progress, 0, _READING))
            more = between(progress, _READING, 1)
            made = correct(pixels, phase_at, loaded, method, iterations, more, name=str(image))
            about = {"image": image.name, "with": source.name, "method": method}
            _write(out, made, about)
    except Interrupted:
        raise Interrupted(f"interrupted: {out} is not written") from None
    noise = "noise unknown" if math.isnan(made.chi_square) else f"chi-square {made.chi_square:.2f}"
    share = f"{100 * made.inside.mean():.0f} % of the pixels lie in the measured field"
    typer.echo(f"{counted(made.iterations, 'iteration')}, {noise}; {share}; the image is in {out}")
    terminal.print_version_notice(source)


def correct(
    image: Counts,
    phase_at: PhaseAt,
    bench: Bench,
    method: RestorationMethod,
    iterations: int,
    progress: Progress,
    *,
    name: str,
) -> CorrectedImage:
    """Correct an image with the geometry of a bench; `name` stands for the image in errors."""
    from reconstruction.deconvolution.corrected_image import corrected_image

    if bench.imaging is None:
        raise InputError(
            f"{name}: its scale is unknown: give --scale, the size of a pixel in the field in m, or [imaging] pixel_m"
        )
    try:
        return corrected_image(
            image,
            phase_at,
            bench.imaging,
            sensor=bench.sensor,
            field=bench.field,
            method=method,
            iterations=iterations,
            progress=progress,
        )
    except ValueError as error:
        raise InputError(f"{name}: {error}") from error


def _section(path: Path | None) -> list[str]:
    """Read the section [imaging] of a TOML file as settings."""
    if path is None:
        return []
    from app.bench.bench_files import read_bench_text

    try:
        section = tomllib.loads(read_bench_text(path)).get("imaging")
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {in_words(error)}") from error
    if not isinstance(section, dict) or not section:
        raise InputError(f"{path}: has no section [imaging]")
    return [f"imaging.{key}={json.dumps(value, default=str)}" for key, value in section.items()]


def _write(out: Path, corrected: CorrectedImage, about: dict[str, Any]) -> None:
    """Write a TIFF: the image, and on a second page 255 where it is corrected, else 0."""
    import numpy as np
    import tifffile

    chi_square = corrected.chi_square if np.isfinite(corrected.chi_square) else None
    facts = {**about, "iterations": corrected.iterations, "chi_square": chi_square}
    with atomic_write(out) as temporary, tifffile.TiffWriter(temporary) as writer:
        writer.write(corrected.image, description=json.dumps(facts), metadata=None)
        marked = np.where(corrected.inside, 255, 0).astype(np.uint8)
        writer.write(marked, description="255 where the image is corrected", metadata=None)
