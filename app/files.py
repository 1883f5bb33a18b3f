"""Image files and atomic writes."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from app.errors import InputError, RunError


def read_image(path: Path) -> NDArray[Any]:
    """Read a grey image (row, column) from a TIFF or NPY file; `InputError` if it is not one."""
    if not path.is_file():
        raise InputError(f"{path}: no such file" if not path.exists() else f"{path}: not a file")
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # a damaged file raises below
    try:
        image = np.load(path, allow_pickle=False) if path.suffix.lower() == ".npy" else tifffile.imread(path)
    except Exception as error:
        raise InputError(f"{path}: cannot be read as TIFF or NPY: {error}") from error
    if not isinstance(image, np.ndarray) or image.ndim != 2 or 0 in image.shape:
        shape = " x ".join(str(length) for length in np.shape(image)) or "nothing"
        raise InputError(f"{path}: holds {shape}; one grey image is needed (rows x columns)")
    if image.dtype.kind not in "uif":
        raise InputError(f"{path}: holds {image.dtype} values; a grey image is needed")
    return image


def make_folder(path: Path) -> None:
    """Make a folder and its parents unless they exist."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{path}: the folder cannot be made: {error.strerror or error}") from error


def nearest_existing(path: Path) -> Path:
    """Return the path if it exists, else its nearest existing parent; `OSError` if access is denied."""
    return next(each for each in (path.absolute(), *path.absolute().parents) if each.exists())


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` on success and is deleted on failure (atomic write)."""
    if not path.name or (path.exists() and not path.is_file()):
        raise RunError(f"{path}: not a file that can be written")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial{path.suffix}")
    try:
        make_folder(path.parent)
        try:
            yield temporary
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_image(path: Path, image: NDArray[Any]) -> None:
    """Write an image (row, column) as TIFF."""
    with atomic_write(path) as temporary:
        tifffile.imwrite(temporary, image)
