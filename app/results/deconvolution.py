"""Images of the sample without the measured aberration (docs/corrected_images.md)."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tifffile
import typer
import xarray as xr

from app.bench.bench_files import BenchError, read_bench_text
from app.bench.config import Bench, as_bench
from app.errors import InputError
from app.files import atomic_write, check_readable, in_words
from app.images import IMAGE_FORMATS, read_image
from app.measurement.bench_reconstructor import as_image
from app.progress import Progress, between, counted
from app.results.analysis import Analysis, Frames, Set
from app.results.sources import mean_wavefront, phase_of, read_bench_of
from reconstruction.arrays import Counts
from reconstruction.deconvolution.corrected_image import PhaseAt, RestorationMethod, corrected_image
from reconstruction.wavefront import Wavefront

_READING = 0.1  # share of the work


@dataclass(frozen=True, kw_only=True)
class Deconvolution(Analysis):
    """Deconvolve an image by the measured aberration of each field position.

    The image was taken through the same sample; the middle of the field is the middle of the image unless
    imaging.center_x_px and center_y_px say otherwise. Several frames are averaged. Pixels outside the measured field
    stay as they are. The noise is estimated from the image, or given by imaging.counts_per_electron and
    read_noise_counts. See docs/corrected_images.md.

    Example: svwfs deconvolve cells.tif --with result.nc --scale 2.5e-6 --out corrected.tif

    Example: svwfs deconvolve cells.tif --with run1 --frames 0:10 --imaging bench.toml --out corrected.tif

    Example: svwfs deconvolve cells.tif --with result.nc --scale 2.5e-6 --set imaging.rotation_rad=1.57 --out c.tif
    """

    source: ClassVar = Annotated[
        Path,
        typer.Option("--with", metavar="RESULT|RUN", help="Wavefronts: file of results, or folder of a recording."),
    ]
    file_help: ClassVar = "TIFF file to write; its second page is 255 where the image is corrected."
    suffixes: ClassVar = (".tif", ".tiff")
    picture_dpi: ClassVar = 0
    closing: ClassVar = "; the image is in {out}"

    image: Annotated[Path, typer.Argument(help=f"Image of the sample, grey: {IMAGE_FORMATS}.")]
    scale: Annotated[
        float | None, typer.Option(metavar="METRES", help="Size of a pixel in the field; same as imaging.pixel_m.")
    ] = None
    imaging: Annotated[
        Path | None, typer.Option(metavar="TOML", help="File with a section [imaging], instead of the bench's.")
    ] = None
    method: Annotated[RestorationMethod, typer.Option(help="wiener is faster and allows negative values.")] = (
        "richardson-lucy"
    )
    iterations: Annotated[
        int, typer.Option(min=1, max=10_000, help="At most; it ends earlier when only noise is left.")
    ] = 50
    frames: Frames = None
    setting: Set = None

    def bench(self, source: Path) -> Bench:
        """Return the bench with the section [imaging] of the file, the scale, and changed settings."""
        scale = () if self.scale is None else (f"imaging.pixel_m={self.scale!r}",)
        try:
            return read_bench_of(source, (*_section(self.imaging), *scale, *(self.setting or ())))
        except BenchError as error:
            if error.fault is not None and error.fault.path == "imaging.pixel_m" and scale:
                raise InputError(f"--scale (imaging.pixel_m) {error.fault.why}") from error
            if error.fault is not None and error.fault.path.startswith("imaging.") and self.imaging is not None:
                raise InputError(f"{self.imaging}: {error.fault}") from error
            raise

    def more_files(self, source: Path) -> tuple[Iterable[Path], Iterable[Path]]:
        """Return image and settings as inputs."""
        files = self.bench(source).files
        check_readable(self.image)
        return [self.image, *filter(None, [self.imaging]), *files], ()

    def compute(self, source: Path, progress: Progress) -> tuple[Bench, xr.Dataset]:
        """Return the corrected image, and where it is corrected."""
        bench, pixels = self.bench(source), read_image(self.image)
        phase_at = mean_wavefront(source, bench, self.frames, between(progress, 0, _READING))
        return bench, self.correct(pixels, phase_at, bench, between(progress, _READING, 1))

    def correct(self, image: Counts, phase_at: PhaseAt, bench: Bench, progress: Progress) -> xr.Dataset:
        """Correct an image (row, column), counts, with the geometry of a bench.

        Returns `image`, and `inside`: where it is corrected, with `iterations` and `chi_square` as attributes.
        """
        if bench.imaging is None:
            raise InputError(
                f"{self.image}: its scale is unknown: give --scale, the size of a pixel in the field in m, or [imaging]"
                " pixel_m"
            )
        try:
            made = corrected_image(
                image,
                phase_at,
                bench.imaging,
                sensor=bench.sensor,
                field=bench.field,
                method=self.method,
                iterations=self.iterations,
                progress=progress,
            )
        except ValueError as error:
            raise InputError(f"{self.image}: {error}") from error
        pixels = ("row", "column")
        attributes = {"iterations": made.iterations, "chi_square": made.chi_square}
        return xr.Dataset({"image": (pixels, made.image), "inside": (pixels, made.inside)}, attrs=attributes)

    def sentences(self, found: xr.Dataset) -> list[str]:
        """Say how well the image fits, and how much of it is corrected."""
        chi_square, inside = found.attrs["chi_square"], float(found["inside"].mean())
        noise = "noise unknown" if math.isnan(chi_square) else f"chi-square {chi_square:.2f}"
        share = f"{100 * inside:.0f} % of the pixels lie in the measured field"
        return [f"{counted(found.attrs['iterations'], 'iteration')}, {noise}; {share}"]

    def write(self, found: xr.Dataset, bench: Bench, source: Path, out: Path) -> None:  # noqa: ARG002 - as in `Analysis`
        """Write a TIFF: the image, and on a second page 255 where it is corrected, else 0."""
        chi_square = found.attrs["chi_square"]
        facts = {
            "image": self.image.name,
            "with": source.name,
            "method": self.method,
            "iterations": found.attrs["iterations"],
            "chi_square": chi_square if math.isfinite(chi_square) else None,
        }
        with atomic_write(out) as temporary, tifffile.TiffWriter(temporary) as writer:
            writer.write(found["image"].values, description=json.dumps(facts), metadata=None)
            marked = np.where(found["inside"], 255, 0).astype(np.uint8)
            writer.write(marked, description="255 where the image is corrected", metadata=None)


def deconvolve(
    image: Counts,
    source: Wavefront | str | Path,
    bench: Bench,
    *,
    method: RestorationMethod = Deconvolution.method,
    iterations: int = Deconvolution.iterations,
) -> xr.DataArray:
    """Remove the aberration of each field position from an image of the sample (docs/corrected_images.md).

    Parameters
    ----------
    image
        Counts, (row, column), taken through the same sample.
    source
        A wavefront, a file of results, or the folder of a recording, whose frames are averaged.
    bench
        The bench; its `[imaging]` has the scale of the image, and its pupil.
    method
        Richardson-Lucy keeps light positive; Wiener is faster.
    iterations
        At most; it ends earlier when only noise is left.

    Returns
    -------
    xarray.DataArray
        Corrected counts (row, column), float32, with the coordinate `inside`: True within the measured field, beyond
        which the image is as before. The attributes have `iterations` and `chi_square`.

    Raises
    ------
    InputError
        If image, wavefront and bench do not go together; the message says why.

    Examples
    --------
    >>> bench = svwfs.load_bench("small_demo", "imaging.pixel_m=10e-6")
    >>> image = images.frames[0]  # here your own image of the sample
    >>> corrected = svwfs.deconvolve(image, wavefront, bench, iterations=3)
    >>> corrected.shape, bool(corrected.inside.any())
    ((240, 256), True)
    """
    bench = as_bench(bench)
    phase_at = phase_of(source, bench)
    chosen = Deconvolution(image=Path("image"), method=method, iterations=iterations)
    made = chosen.correct(as_image(image, "image"), phase_at, bench, lambda *_: None)
    return made["image"].rename(None).assign_coords(inside=made["inside"]).assign_attrs(units="counts", **made.attrs)


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
