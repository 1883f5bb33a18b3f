"""Images of the sample without the measured aberration (docs/field.md)."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import tifffile
import xarray as xr

from app.bench.config import Bench, as_bench
from app.errors import InputError
from app.files import atomic_write
from app.measurement.offline_reconstructor import as_image
from app.progress import Progress
from app.results.sources import phase_of
from reconstruction.arrays import Counts
from reconstruction.deconvolution.corrected_image import PhaseAt, RestorationMethod, corrected_image
from reconstruction.wavefront import Wavefront

METHOD: RestorationMethod = "richardson-lucy"  # unless another is chosen
MOST_ITERATIONS = 50  # unless another number is chosen


def deconvolve(
    image: Counts,
    source: Wavefront | str | Path,
    bench: Bench,
    *,
    method: RestorationMethod = METHOD,
    iterations: int = MOST_ITERATIONS,
) -> xr.DataArray:
    """Remove the aberration of each field position from an image of the sample (docs/field.md).

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
    made = correct(as_image(image, "image"), phase_at, bench, method=method, iterations=iterations)
    return made["image"].rename(None).assign_coords(inside=made["inside"]).assign_attrs(units="counts", **made.attrs)


def correct(
    image: Counts,
    phase_at: PhaseAt,
    bench: Bench,
    *,
    name: str | Path = "image",
    method: RestorationMethod = METHOD,
    iterations: int = MOST_ITERATIONS,
    progress: Progress = lambda *_: None,
) -> xr.Dataset:
    """Correct an image (row, column), counts, with the geometry of a bench; errors call it by its `name`.

    Returns `image`, and `inside`: where it is corrected, with `iterations` and `chi_square` as attributes.
    """
    if bench.imaging is None:
        raise InputError(
            f"{name}: its scale is unknown: give --scale, the size of a pixel in the field in m, or [imaging] pixel_m"
        )
    try:
        made = corrected_image(
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
    pixels = ("row", "column")
    attributes = {"method": method, "iterations": made.iterations, "chi_square": made.chi_square}
    return xr.Dataset({"image": (pixels, made.image), "inside": (pixels, made.inside)}, attrs=attributes)


def write_corrected(path: Path, found: xr.Dataset, names: dict[str, str]) -> None:
    """Write a TIFF: image, second page with 255 where it is corrected, else 0, and names of image and wavefronts."""
    chi_square = found.attrs["chi_square"]
    facts = {**names, **found.attrs, "chi_square": chi_square if math.isfinite(chi_square) else None}
    with atomic_write(path) as temporary, tifffile.TiffWriter(temporary) as writer:
        writer.write(found["image"].values, description=json.dumps(facts), metadata=None)
        marked = np.where(found["inside"], 255, 0).astype(np.uint8)
        writer.write(marked, description="255 where the image is corrected", metadata=None)
