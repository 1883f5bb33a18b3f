"""Stacks of images as BigTIFF with the metadata of ImageJ, written image by image."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import tifffile
from numpy.typing import NDArray

from app.files import atomic_write


def write_stack(
    path: Path,
    images: Iterable[NDArray[Any]],
    *,
    labels: Sequence[str],
    information: str,
    pixel_um: float,
    interval_s: float | None = None,
) -> None:
    """Write as many images (row, column), all of a size and type, as there are `labels`; one is in memory at a time.

    ImageJ (as Fiji, with Bio-Formats) shows the label above each image, `information` under Image > Show Info, and
    lengths in um; with an `interval_s` the images are frames of a film. The library's own way to write for ImageJ ends
    at 4 GB; this is its BigTIFF, with the same description and tags.
    """
    remaining = iter(images)
    first = next(remaining)
    shape = (len(labels), *first.shape)
    film: dict[str, Any] = {} if interval_s is None else {"finterval": interval_s}
    tags = tifffile.imagej_metadata_tag({"Info": information, "Labels": list(labels)}, "<")
    with atomic_write(path) as temporary, tifffile.TiffWriter(temporary, bigtiff=True, byteorder="<") as writer:
        writer.write(
            chain([first], remaining),
            shape=shape,
            dtype=first.dtype,
            photometric="minisblack",
            description=tifffile.imagej_description(shape, axes="TYX" if film else "ZYX", unit="um", **film),
            metadata=None,  # the library's own; the description says it all
            extratags=tags,
            resolution=(1 / pixel_um, 1 / pixel_um),
            resolutionunit="NONE",
        )
