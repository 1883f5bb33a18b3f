"""Image files: grey frames of any camera program in, TIFF out."""

import logging
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from app.errors import InputError
from app.files import atomic_write, check_readable, in_words
from reconstruction.arrays import Floats, reading_npy

IMAGE_FORMATS = "TIFF, NPY, FITS, PNG, BMP or PGM"
SUFFIXES = frozenset({".tif", ".tiff", ".npy", ".fits", ".fit", ".fts", ".png", ".bmp", ".pgm"})
MOST_COUNTS = 1e12  # of a pixel; beyond, single precision overflows soon
_MOST_PIXELS = 2**28  # a small file can claim to hold more than the memory
_ORIENTATION, _WHITE_IS_ZERO = 274, 0  # of TIFF: a tag, and a photometric interpretation
_JPEG, _FITS, _PICTURES = b"\xff\xd8\xff", b"SIMPLE  =", (b"\x89PNG", b"BM", b"P5")
_TEXT = b"P2"
_TIFF = b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"  # of either order of bytes; the last two of BigTIFF
_FITS_BLOCK_BYTES, _FITS_CARD_BYTES = 2880, 80
_FITS_SIZE = "BITPIX, NAXIS, BSCALE or BZERO"
_FITS_SCALING = ("BSCALE", "1"), ("BZERO", "0")
_FITS_TYPES = {"8": ">u1", "16": ">i2", "32": ">i4", "64": ">i8", "-32": ">f4", "-64": ">f8"}  # of BITPIX


def read_image(path: Path) -> NDArray[Any]:
    """Read a grey image (row, column) from a file; `InputError` if it holds none.

    The first bytes tell the format. Three equal channels are one grey image.
    """
    check_readable(path)
    try:
        image = _read(path)
    except Exception as error:
        raise InputError(f"{path}: cannot be read as {IMAGE_FORMATS}: {in_words(error)}") from error
    if np.ndim(image) == 3 and image.shape[2] in {3, 4}:
        if not np.array_equal(image[..., :2], image[..., 1:3], equal_nan=image.dtype.kind == "f"):
            raise InputError(f"{path}: is a colour image; save one of its channels as a grey image")
        image = image[..., 0]
    if not isinstance(image, np.ndarray) or image.ndim != 2 or 0 in image.shape:
        shape = " x ".join(str(length) for length in np.shape(image)) or "nothing"
        raise InputError(f"{path}: holds {shape}; one grey image is needed (rows x columns)")
    if image.dtype.kind not in "uif":
        raise InputError(f"{path}: holds {image.dtype} values; a grey image is needed")
    if image.dtype == np.float16:  # its sums overflow
        image = image.astype(np.float32)
    known = np.isfinite(image)
    if max(float(np.max(image, where=known, initial=0)), -float(np.min(image, where=known, initial=0))) > MOST_COUNTS:
        raise InputError(f"{path}: holds values beyond {MOST_COUNTS:g}; counts are needed")
    return image


def _read(path: Path) -> NDArray[Any]:
    with path.open("rb") as file:
        start = file.read(len(_FITS))
    if not start:
        raise ValueError("it is empty")
    if start.startswith(_TEXT):
        raise ValueError("it holds its numbers as text; save it as a binary PGM (P5)")
    if start.startswith(np.lib.format.MAGIC_PREFIX):
        with reading_npy():
            # Fails if the file is shorter than its header says.
            mapped = np.load(path, mmap_mode="r", allow_pickle=False)
            _require_few_pixels(mapped.shape)
            return np.array(mapped)
    if start == _FITS:
        return _read_fits(path)
    if start.startswith(_PICTURES):
        return _read_picture(path)
    if start.startswith(_JPEG):
        raise ValueError("JPEG changes the light of every pixel; save the frame in another format")
    if start.startswith(_TIFF):
        return _read_tiff(path)
    raise ValueError("it is another kind of file")


def _require_few_pixels(shape: tuple[int, ...]) -> None:
    if math.prod(shape) > _MOST_PIXELS:
        raise ValueError(f"{' x '.join(map(str, shape))} pixels are too many")


def _read_tiff(path: Path) -> NDArray[Any]:
    """Read the only image of a file, besides previews, turned as its tag says."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # a damaged file raises below
    with tifffile.TiffFile(path, is_ome=False) as file:  # OME's text may claim any number of planes
        images = [series for series in file.series if not series.keyframe.is_reduced]
        (series,) = _only(images)
        _require_few_pixels(series.shape)
        if series.keyframe.photometric == _WHITE_IS_ZERO:
            raise ValueError("it is a negative, in which 0 is white; save it with 0 as black")
        tag, compression = series.keyframe.tags.get(_ORIENTATION), series.keyframe.compression
        refusal = ValueError(f"it is compressed ({compression.name}); save it without compression")
        if compression not in tifffile.TIFF.DECOMPRESSORS:
            raise refusal
        try:
            image = series.asarray()
        except ImportError as error:  # this Python lacks what undoes it
            raise refusal from error
        if series.axes == "SYX":  # its channels are stored one after the other
            image = np.moveaxis(image, 0, -1)
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


def _read_fits(path: Path) -> NDArray[Any]:
    """Read the only image of a file, its first row first (FITS 4.0, sections 3 - 5)."""
    stored, at, images = np.memmap(path, np.uint8, "r"), 0, []
    while at < len(stored) and (at == 0 or stored[at : at + 8].tobytes() == b"XTENSION"):
        header, at = _fits_header(stored, at)
        if header.get("ZIMAGE") == "T":
            raise ValueError("its image is compressed; unpack it, for example with funpack")
        try:
            shape = [int(header[f"NAXIS{axis}"]) for axis in range(int(header["NAXIS"]), 0, -1)]
            kind = np.dtype(_FITS_TYPES[header["BITPIX"]])
            scale, zero = (float(header.get(name, default).replace("D", "E")) for name, default in _FITS_SCALING)
        except (KeyError, ValueError) as error:
            raise ValueError(f"its header has no valid {_FITS_SIZE}: {error}") from None
        if min(shape, default=0) < 0 or not math.isfinite(zero) or not math.isfinite(scale) or not scale:
            raise ValueError(f"its header has no valid {_FITS_SIZE}")
        pixels = math.prod(shape) if shape else 0
        length = (pixels + int(header.get("PCOUNT", 0))) * int(header.get("GCOUNT", 1)) * kind.itemsize
        if not 0 <= length <= len(stored) - at:
            raise ValueError("it ends before its last pixel")
        if pixels and header.get("XTENSION", "IMAGE") == "IMAGE":
            images.append((header.get("BLANK"), scale, zero, np.frombuffer(stored, kind, pixels, at).reshape(shape)))
        at += -(-length // _FITS_BLOCK_BYTES) * _FITS_BLOCK_BYTES
    ((blank, scale, zero, values),) = _only(images)
    values = np.reshape(values, [length for length in values.shape if length > 1]) if values.ndim > 2 else values
    if blank is not None and values.dtype.kind != "f" and (undefined := values == int(blank)).any():
        return np.where(undefined, np.nan, np.asarray(values * scale + zero, np.float64))
    if (scale, zero) == (1.0, 0.0):
        return values.astype(values.dtype.newbyteorder("="))
    if values.dtype.kind == "i" and (scale, zero) == (1.0, -float(np.iinfo(values.dtype).min)):
        return (values.astype(values.dtype.newbyteorder("=")) ^ np.iinfo(values.dtype).min).view(f"u{values.itemsize}")
    return np.asarray(values * scale + zero)


def _fits_header(stored: NDArray[np.uint8], at: int) -> tuple[dict[str, str], int]:
    """Read the header that begins at a byte: values without comments and quotes, and the byte after it."""
    header: dict[str, str] = {}
    for start in range(at, len(stored) - _FITS_CARD_BYTES + 1, _FITS_CARD_BYTES):
        card = stored[start : start + _FITS_CARD_BYTES].tobytes().decode("latin-1")
        if card.rstrip() == "END":
            return header, at + -(-(start + _FITS_CARD_BYTES - at) // _FITS_BLOCK_BYTES) * _FITS_BLOCK_BYTES
        if card[8:10] == "= ":
            header[card[:8].rstrip()] = card[10:].split("/")[0].strip(" '")
    raise ValueError("its header has no end")


def _only(images: list[Any]) -> list[Any]:
    if len(images) != 1:
        raise ValueError(f"it holds {len(images)} images; save one frame")
    return images


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


def fits_file(image: Floats, unit: str) -> bytes:
    """Return a FITS file of 32-bit floats, its first row first (FITS 4.0, sections 4 and 5)."""
    rows, columns = image.shape
    cards: dict[str, Any] = {"SIMPLE": "T", "BITPIX": -32, "NAXIS": 2, "NAXIS1": columns, "NAXIS2": rows}
    lines = [f"{name:8}= {value:>20}" for name, value in cards.items()] + [f"BUNIT   = '{unit:8}'", "END"]
    header = "".join(f"{line:{_FITS_CARD_BYTES}}" for line in lines).encode("ascii")
    parts = header.ljust(-(-len(header) // _FITS_BLOCK_BYTES) * _FITS_BLOCK_BYTES), image.astype(">f4").tobytes()
    return b"".join(parts).ljust(-(-sum(map(len, parts)) // _FITS_BLOCK_BYTES) * _FITS_BLOCK_BYTES, b"\0")
