"""Image files: grey frames of any camera program in, TIFF out."""

import logging
import math
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile
from numpy.typing import NDArray

from app.errors import InputError
from app.files import atomic_write, check_readable, in_words
from reconstruction.arrays import reading_npy

IMAGE_FORMATS = "TIFF, FITS, HDF5, MAT, NPY, NPZ, PNG, BMP or PGM"
_FITS_SUFFIXES = {".fits", ".fit", ".fts", ".fz", ".gz"}
SUFFIXES = frozenset({".tif", ".tiff", ".npy", ".npz", ".h5", ".hdf5", ".mat", ".png", ".bmp", ".pgm"} | _FITS_SUFFIXES)
MOST_COUNTS = 1e12  # of a pixel; beyond, single precision overflows soon
_ORIENTATION, _WHITE_IS_ZERO = 274, 0  # of TIFF: a tag, and a photometric interpretation
_FITS, _PICTURES = b"SIMPLE  =", (b"\x89PNG", b"BM", b"P2", b"P5")
_GZIP = b"\x1f\x8b"
_INDEX = re.compile(r"\[(-?\d{1,9})\]$")
_TIFF = b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"  # of either order of bytes; the last two of BigTIFF
_HDF5, _MAT, _MAT_IN_HDF5, _NPZ = b"\x89HDF\r\n\x1a\n", b"MATLAB 5.0", b"MATLAB 7.3", b"PK\x03\x04"
MOST_PIXELS = 2**28  # a small file can claim to hold more than the memory
_SHOWN = 5  # arrays in an error
_NUMBERS = "uif"  # kinds of NumPy's types


class ImagePlace(NamedTuple):
    """A file, the name of an array in it, and the number of an image in a stack: file.h5:/path/to/data[3]."""

    file: Path
    name: str = ""
    number: int | None = None


def place_of(path: Path) -> ImagePlace:
    """Return the file that a path names, with array and number; a file whose name has such parts is itself meant."""
    if path.exists():
        return ImagePlace(path)
    text = str(path)
    index = _INDEX.search(text)
    number = None if index is None else int(index[1])
    rest = text if index is None else text[: index.start()]
    if Path(rest).exists():
        return ImagePlace(Path(rest), number=number)
    file, _, name = rest.rpartition(":")
    return ImagePlace(Path(file), name, number) if file and Path(file).is_file() else ImagePlace(Path(rest), "", number)


def name_of(path: Path) -> str:
    """Return the name of an image without its folders."""
    return str(path)[len(str(place_of(path).file.parent / "x")) - 1 :]


def read_image(path: Path) -> NDArray[Any]:
    """Read a grey image (row, column), or three equal channels, at an `ImagePlace`; `InputError` if there is none."""
    place = place_of(path)
    check_readable(place.file)
    try:
        image = _read(place)
    except Exception as error:
        raise InputError(f"{path}: cannot be read as {IMAGE_FORMATS}: {in_words(error)}") from error
    if np.ndim(image) > 2 and np.size(image):
        image = np.reshape(image, [length for length in np.shape(image) if length > 1])
    if np.ndim(image) == 3 and image.shape[2] in {3, 4}:
        if not np.array_equal(image[..., :2], image[..., 1:3], equal_nan=image.dtype.kind == "f"):
            raise InputError(f"{path}: is a colour image; save one of its channels as a grey image")
        image = image[..., 0]
    if not isinstance(image, np.ndarray) or image.ndim != 2 or 0 in image.shape:
        shape = " x ".join(str(length) for length in np.shape(image)) or "nothing"
        choose = f"; of several choose one, as {path}[0]" if np.ndim(image) == 3 else ""
        raise InputError(f"{path}: holds {shape}; one grey image is needed (rows x columns){choose}")
    if image.dtype.kind not in "uif":
        raise InputError(f"{path}: holds {image.dtype} values; a grey image is needed")
    if image.dtype == np.float16:  # its sums overflow
        image = image.astype(np.float32)
    known = np.isfinite(image)
    if max(float(np.max(image, where=known, initial=0)), -float(np.min(image, where=known, initial=0))) > MOST_COUNTS:
        raise InputError(f"{path}: holds values beyond {MOST_COUNTS:g}; counts are needed")
    return image


def _read(place: ImagePlace) -> NDArray[Any]:
    path, name, index = place
    with path.open("rb") as file:
        start = file.read(10)
    if not start:
        raise ValueError("it is empty")
    if is_container(start, path):
        return read_array(start, path, name, index)
    if name:
        raise ValueError(f"only HDF5, MAT and NPZ hold arrays with names: leave :{name} out")
    if start.startswith(_TIFF):
        return _read_tiff(path, index)
    if start.startswith((_FITS, _GZIP)):
        return _read_fits(path, index)
    if start.startswith(np.lib.format.MAGIC_PREFIX):
        return _read_npy(path, index)
    if start.startswith(_PICTURES):
        return plane_of(_read_picture(path), index) if index is not None else _read_picture(path)
    raise ValueError(
        "it is another kind of file, such as text or JPEG; save the frame as TIFF with the bits of the camera"
    )


def _read_npy(path: Path, index: int | None) -> NDArray[Any]:
    with reading_npy():
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)  # fails if the file is shorter than its header says
        plane = mapped if index is None else plane_of(mapped, index)
        require_few_pixels(plane.shape)
        return np.array(plane)


def _read_tiff(path: Path, index: int | None) -> NDArray[Any]:
    """Read the only image of a file, or the one with an index, besides previews, turned as its tag says."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # a damaged file raises below
    with tifffile.TiffFile(path, is_ome=False) as file:  # OME's text may claim any number of planes
        pages: Any = () if index is None else file.pages
        images = [page for page in pages if not page.keyframe.is_reduced]
        if len(images) < 2:  # a stack may be a single page
            images = [series for series in file.series if not series.keyframe.is_reduced]
        series, index = _image_of(images, path, index)
        require_few_pixels(series.shape)
        if series.keyframe.photometric == _WHITE_IS_ZERO:
            raise ValueError("it is a negative, in which 0 is white; save it with 0 as black")
        tag, compression = series.keyframe.tags.get(_ORIENTATION), series.keyframe.compression
        by = getattr(compression, "name", compression)  # a number if the file leaves it out
        refusal = ValueError(f"it is compressed ({by}); save it without compression")
        if compression not in tifffile.TIFF.DECOMPRESSORS:
            raise refusal
        try:
            image = series.asarray()
        except ImportError as error:  # this Python lacks what undoes it
            raise refusal from error
        if series.axes == "SYX" and index is None:  # its channels are stored one after the other
            image = np.moveaxis(image, 0, -1)
        image = image if index is None else plane_of(image, index)
        return image if tag is None or image.ndim != 2 else _upright(image, int(tag.value))


def _upright(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Turn or mirror an image (row, column) as stored with an orientation of TIFF, 1 ... 8."""
    image = image.T if orientation in {5, 6, 7, 8} else image
    image = image[::-1] if orientation in {3, 4, 7, 8} else image
    image = image[:, ::-1] if orientation in {2, 3, 6, 7} else image
    return np.ascontiguousarray(image)


def _read_picture(path: Path) -> NDArray[Any]:
    """Read a PNG, BMP or PGM with the bits that it has."""
    from reconstruction.runtime.opencv import cv2  # noqa: PLC0415 - most commands read none

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # a damaged file raises below
    with _silenced():
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("it is damaged or too large")
    return np.asarray(image)


@contextmanager
def _silenced() -> Iterator[None]:
    """Keep what the C library of PNG says of a damaged file, which raises anyway, off the terminal."""
    try:
        kept = os.dup(2)
    except OSError:  # a window on Windows has no terminal
        yield
        return
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _read_fits(path: Path, index: int | None) -> NDArray[Any]:
    """Read the only image of a file, packed or not, or the one with an index, its first row first."""
    from astropy.io import fits  # noqa: PLC0415 - few images need it

    with warnings.catch_warnings(), path.open("rb") as file:
        warnings.simplefilter("ignore")  # small faults of a header
        warnings.filterwarnings("error", "File may have been truncated")
        try:
            images = [unit for unit in fits.open(file) if unit.is_image and unit.shape]
            image, index = _image_of(images, path, index)
            require_few_pixels(image.shape)
            values, blank = image.data, image.header.get("BLANK")
        except (KeyError, TypeError) as error:
            raise ValueError(f"its header is damaged: {error}") from error
        if values.dtype.kind == "u" and blank is not None:  # elsewhere astropy makes undefined pixels NaN
            values = np.where(values == blank + image.header["BZERO"], np.nan, values)
        return np.array(values if index is None else plane_of(values, index), values.dtype.newbyteorder("="))


def _image_of(images: list[Any], path: Path, index: int | None) -> tuple[Any, int | None]:
    """Return the image with an index of several, or the only one with the index that chooses of its planes."""
    if index is not None and len(images) > 1:
        return images[number_in(images, index)], None
    if len(images) != 1:
        choose = f"; choose one, as {path.name}[0]" if images else ""
        raise ValueError(f"it holds {len(images)} images{choose}")
    return images[0], index


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
    images.sort(key=lambda each: -math.prod(shapes[each]))  # likely ones first
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


def write_image(path: Path, image: NDArray[Any]) -> None:
    """Write an image (row, column) as TIFF."""
    with atomic_write(path) as temporary:
        tifffile.imwrite(temporary, image)


def write_stack(
    path: Path,
    images: Iterable[NDArray[Any]],
    *,
    labels: Sequence[str],
    information: str,
    pixel_um: float,
    interval_s: float | None = None,
) -> None:
    """Write images (row, column) of one size and type, one for each label, as BigTIFF for ImageJ.

    tifffile's own ImageJ mode ends at 4 GB; this writes the same description and tags into a BigTIFF. ImageJ shows
    `labels` above the images, and `information` under Image > Show Info. With an interval they are a film.
    """
    remaining = iter(images)
    first = next(remaining)
    shape, film = (len(labels), *first.shape), dict[str, Any]({} if interval_s is None else {"finterval": interval_s})
    tags = tifffile.imagej_metadata_tag({"Info": information, "Labels": list(labels)}, "<")
    with atomic_write(path) as temporary, tifffile.TiffWriter(temporary, bigtiff=True, byteorder="<") as writer:
        writer.write(
            chain([first], remaining),
            shape=shape,
            dtype=first.dtype,
            photometric="minisblack",
            description=tifffile.imagej_description(shape, axes="TYX" if film else "ZYX", unit="um", **film),
            metadata=None,  # replaced by the description
            extratags=tags,
            resolution=(1 / pixel_um, 1 / pixel_um),
            resolutionunit="NONE",
        )
