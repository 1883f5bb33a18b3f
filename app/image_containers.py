"""Arrays in files that may hold many, HDF5, MAT and NPZ: the one that is named, or the only image."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sized
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HDF5, _MAT, _MAT_IN_HDF5, _NPZ = b"\x89HDF\r\n\x1a\n", b"MATLAB 5.0", b"MATLAB 7.3", b"PK\x03\x04"
MOST_PIXELS = 2**28  # a small file can claim to hold more than the memory
_SHOWN = 5  # arrays in an error
_NUMBERS = "uif"  # kinds of NumPy's types


def is_container(start: bytes, path: Path) -> bool:
    """True if a file with these first bytes may hold several arrays; old MAT files show it by their suffix alone."""
    return start.startswith((_HDF5, _MAT, _MAT_IN_HDF5, _NPZ)) or path.suffix.lower() == ".mat"


def read_array(start: bytes, path: Path, name: str, index: int | None) -> NDArray[Any]:
    """Read the array with a name, without one the only image, and of a stack the image with an index.

    Stacks lie along the last axis in MAT files, else along the first. `ValueError` says what to name instead.
    """
    opened = _opened_mat if path.suffix.lower() == ".mat" or start.startswith(_MAT) else _opened_npz
    in_matlab = start.startswith(_MAT_IN_HDF5)
    if in_matlab or start.startswith(_HDF5):
        opened = _opened_hdf5
    with opened(path) as arrays:
        stored = arrays[_chosen({each: array.shape for each, array in arrays.items()}, path, name.strip("/"))]
        plane = stored if index is None else plane_of(stored, index, axis=-1 if opened is _opened_mat else 0)
        require_few_pixels(plane.shape)
        image = np.array(plane)
    return image.T if in_matlab else image  # MATLAB's columns are rows there


def plane_of(stack: Any, index: int, axis: int = 0) -> NDArray[Any]:
    """Return one image of a stack, counted from 0; `ValueError` if there is no such image."""
    if stack.ndim < 3:
        stack = np.asarray(stack)[None] if axis == 0 else np.asarray(stack)[..., None]
    number = number_in(range(stack.shape[axis]), index)
    return np.asarray(stack[number] if axis == 0 else stack[..., number])


def number_in(images: Sized, index: int) -> int:
    """Return an index, which may count from the end, from the beginning; `ValueError` if there is no such image."""
    count = len(images)
    if not -count <= index < count:
        raise ValueError(f"it has no image {index}: they are counted from 0, their number is {count}")
    return index % count


def require_few_pixels(shape: tuple[int, ...]) -> None:
    """Raise `ValueError` if an array would not fit in memory."""
    if math.prod(shape) > MOST_PIXELS:
        raise ValueError(f"{' x '.join(map(str, shape))} pixels are too many; of a stack choose one image, as [0]")


def _chosen(shapes: dict[str, tuple[int, ...]], path: Path, name: str) -> str:
    """Return the name of an array that is there; without a name, that of the only one that is an image."""
    if name in shapes:
        return name
    images = [each for each, shape in shapes.items() if sum(length > 1 for length in shape) > 1]
    if not name and len(images) == 1:
        return images[0]
    listed = ", ".join(f"{each} ({' x '.join(map(str, shapes[each]))})" for each in images[:_SHOWN])
    if not images:
        raise ValueError("it holds no image, an array of numbers with rows and columns")
    missing = f"it has no array {name}; " if name else ""
    more = f" and {len(images) - _SHOWN} more" if len(images) > _SHOWN else ""
    raise ValueError(f"{missing}it holds {listed}{more}: name one, as {path.name}:{images[0]}")


@contextmanager
def _opened_hdf5(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the datasets of numbers by their paths, which are read when they are indexed."""
    import h5py  # noqa: PLC0415 - few images need it

    found: dict[str, Any] = {}

    def take(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.shape is not None and item.dtype.kind in _NUMBERS:
            found[name] = item

    with h5py.File(path, "r", locking=False) as file:
        file.visititems(take)
        yield {name: item for name, item in found.items() if not name.startswith("#")}


@contextmanager
def _opened_mat(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the arrays of numbers by their names, those in structures as structure/field."""
    import scipy.io  # noqa: PLC0415 - few images need it

    found: dict[str, Any] = {}

    def take(names: tuple[str, ...], value: Any) -> None:
        if isinstance(value, dict):
            for name, each in value.items():
                if not name.startswith("__"):
                    take((*names, name), each)
        elif isinstance(value, np.ndarray) and value.dtype.kind in _NUMBERS:
            found["/".join(names)] = value

    take((), scipy.io.loadmat(path, simplify_cells=True))
    yield found


@contextmanager
def _opened_npz(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the arrays of numbers by their names; Python objects among them are left out."""
    arrays: dict[str, Any] = {}
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        for name in stored.files:
            with suppress(ValueError):
                arrays[name] = stored[name]
    yield {name: array for name, array in arrays.items() if array.dtype.kind in _NUMBERS}
