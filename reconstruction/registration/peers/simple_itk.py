"""SimpleITK for every lenslet: an optional library, loaded when a method that needs it is prepared.

It takes one pair of images a call. Its calls let go of Python's lock, so lenslets are shared among threads, each call
on one: an image of 31 x 31 pixels is too small to be shared any further.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError

THREADS = min(2, os.cpu_count() or 1)


def load_simple_itk() -> Any:
    """Return the module; raise `ReconstructionError` where it is not installed."""
    try:
        import SimpleITK  # noqa: PLC0415 - an optional extra that takes a second to load: only its methods pay for it
    except ImportError as error:
        raise ReconstructionError("this method needs SimpleITK: pip install 'svwfs[peers]'") from error
    return SimpleITK


def for_every_lenslet(
    align: Callable[[Image, Image], Floats | None],
    references: Image,
    subimages: Image,
    shape: tuple[int, ...],
    *,
    threads: int = THREADS,
) -> Floats:
    """Give each pair of the windows (L, width, width) to `align`: what it finds, (L, *shape), NaN where nothing."""
    with ThreadPoolExecutor(threads, thread_name_prefix="simple-itk") as pool:
        found = list(pool.map(align, references, subimages))
    return np.stack([np.full(shape, np.nan) if one is None else one for one in found])
