"""`svwfs deconvolve`: an image of the sample without the measured aberration."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.bench.bench_files import BenchError, read_bench_text
from app.commands import options, terminal
from app.errors import InputError
from app.files import in_words
from app.images import IMAGE_FORMATS, read_image
from app.progress import between, counted
from app.results.deconvolution import METHOD, MOST_ITERATIONS, correct, write_corrected
from app.results.sources import mean_wavefront, read_bench_of
from reconstruction.deconvolution.corrected_image import RestorationMethod

if TYPE_CHECKING:
    from app.bench.config import Bench

_READING = 0.1  # share of the work


def deconvolve(
    image: Annotated[Path, typer.Argument(help=f"Image of the sample, grey: {IMAGE_FORMATS}.")],
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
    method: Annotated[RestorationMethod, typer.Option(help="Method; wiener is faster, with negative values.")] = METHOD,
    iterations: Annotated[
        int, typer.Option(min=1, max=10_000, help="Most iterations; fewer if only noise is left.")
    ] = MOST_ITERATIONS,
    frames: options.Frames = None,
    setting: options.Set = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Deconvolve an image by the measured aberration of each field position.

    The image was taken through the same sample; the middle of the field is the middle of the image unless
    imaging.center_x_px and center_y_px say otherwise. Several frames are averaged. Pixels outside the measured field
    stay as they are. The noise is estimated from the image, or given by imaging.counts_per_electron and
    read_noise_counts. See `svwfs docs field`.

    Example: svwfs deconvolve cells.tif --with result.nc --scale 2.5e-6 --out corrected.tif

    Example: svwfs deconvolve cells.tif --with run1 --frames 0:10 --imaging bench.toml --out corrected.tif

    Example: svwfs deconvolve cells.tif --with result.nc --scale 2.5e-6 --set imaging.rotation_rad=1.57 --out c.tif
    """
    settings = setting or []
    bench = _bench(source, imaging, scale, settings)
    reads = (*options.files_of_images(image), imaging, *bench.files)
    options.check_files(out, reads=reads, sources=[source], suffixes=(".tif", ".tiff"), overwrite=overwrite)
    with terminal.analysing(source, out) as progress:
        pixels = read_image(image)
        phase_at = mean_wavefront(source, bench, frames, between(progress, 0.0, _READING))
        found = correct(
            pixels,
            phase_at,
            bench,
            name=image,
            method=method,
            iterations=iterations,
            progress=between(progress, _READING, 0.9),
        )
        progress("writing", 0.9)
        write_corrected(out, found, {"image": image.name, "with": source.name})
    chi_square, inside = found.attrs["chi_square"], float(found["inside"].mean())
    noise = "noise unknown" if math.isnan(chi_square) else f"chi-square {chi_square:.2f}"
    share = f"{100 * inside:.0f} % of the pixels lie in the measured field"
    typer.echo(f"{counted(found.attrs['iterations'], 'iteration')}, {noise}; {share}; the image is in {out}")
    terminal.print_missing_lines(source)


def _bench(source: Path, imaging: Path | None, scale: float | None, settings: list[str]) -> Bench:
    """Return the bench of `source` with the section [imaging] of a file, the scale, and changed settings."""
    pixel = [] if scale is None else [f"imaging.pixel_m={scale!r}"]
    try:
        return read_bench_of(source, (*_section(imaging), *pixel, *settings))
    except BenchError as error:
        if error.fault is not None and error.fault.path == "imaging.pixel_m" and pixel:
            raise InputError(f"--scale (imaging.pixel_m) {error.fault.why}") from error
        if error.fault is not None and error.fault.path.startswith("imaging.") and imaging is not None:
            raise InputError(f"{imaging}: {error.fault}") from error
        raise


def _section(path: Path | None) -> list[str]:
    """Read the section [imaging] of a TOML file as settings."""
    if path is None:
        return []
    try:
        section = tomllib.loads(read_bench_text(path)).get("imaging")
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {in_words(error)}") from error
    if not isinstance(section, dict) or not section:
        raise InputError(f"{path}: has no section [imaging]")
    return [f"imaging.{key}={json.dumps(value, default=str)}" for key, value in section.items()]
