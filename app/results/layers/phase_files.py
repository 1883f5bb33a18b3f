"""Files of a corrector's phase: NPY, FITS, or an 8-bit picture for a modulator."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from app.errors import InputError
from app.files import atomic_write
from reconstruction.arrays import Floats

_FORMATS = (".npy", ".fits", ".png")
_GREY = 256  # levels of a wrapped phase
_FITS_BLOCK = 2880  # bytes


def check_phase_path(path: Path) -> None:
    """Raise `InputError` if the suffix is no format of a phase."""
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: give a name that ends in one of {', '.join(_FORMATS)}")


def write_phase(path: Path, phase_rad: Floats) -> None:
    """Write a phase map: NPY or FITS in rad, or an 8-bit PNG wrapped at 2 pi, 256 levels to a wave."""
    suffix = path.suffix.lower()
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        if suffix == ".npy":
            np.save(file, phase_rad.astype(np.float32))
        elif suffix == ".fits":
            file.write(_fits(phase_rad))
        else:
            file.write(cv2.imencode(".png", wrapped(phase_rad))[1].tobytes())


def wrapped(phase_rad: Floats) -> NDArray[np.uint8]:
    """Grey levels of a phase for a modulator: 0 ... 255 for 0 ... 2 pi."""
    return np.asarray(np.rint(np.mod(phase_rad, 2 * math.pi) / (2 * math.pi) * _GREY) % _GREY, np.uint8)


def _fits(phase_rad: Floats) -> bytes:
    """Primary HDU of 32-bit floats (FITS 4.0, sections 4 and 5)."""
    rows, columns = phase_rad.shape
    cards: dict[str, Any] = {"SIMPLE": "T", "BITPIX": -32, "NAXIS": 2, "NAXIS1": columns, "NAXIS2": rows}
    lines = [f"{name:8}= {value:>20}" for name, value in cards.items()] + ["BUNIT   = 'rad     '", "END"]
    header = "".join(f"{line:80}" for line in lines).encode("ascii")
    pixels = phase_rad.astype(">f4").tobytes()
    return header.ljust(-(-len(header) // _FITS_BLOCK) * _FITS_BLOCK) + pixels.ljust(
        -(-len(pixels) // _FITS_BLOCK) * _FITS_BLOCK, b"\0"
    )
