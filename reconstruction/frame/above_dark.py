"""Light of an image, its counts above the dark or the background, and its saturated pixels."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Counts, Image, Mask
from reconstruction.errors import ReconstructionError
from reconstruction.runtime.compilation import compiled

_SATURATED_FRACTION = 0.01  # of the image's pixels; with more, it is rejected
_BACKGROUND_PERCENT = 1.0  # without a dark, this percentile of the counts is the background


class AboveDark:
    """Subtracts one dark (row, column), if there is one, from images of one size.

    Pixels from `full_scale` on are saturated.
    """

    def __init__(self, shape: tuple[int, ...], dark: Counts | None, full_scale: float) -> None:
        self._shape, self._full_scale = shape, full_scale
        self._dark: Image | None = None
        if dark is not None:
            self._check(dark, "dark")
            self._dark = _finite(dark, "dark")
            self._of_camera(np.zeros(shape, np.uint16), self._dark)  # compile now instead of at the first frame

    def __call__(self, image: Counts, name: str) -> tuple[Image, Mask]:
        """Light of an image (row, column), counts, and its saturated pixels, the same shape.

        Raises
        ------
        ReconstructionError
            If the image has another size, no grey or infinite values, or many saturated pixels; it says `name`.
        """
        self._check(image, name)
        if self._dark is not None and image.dtype in {np.dtype(np.uint8), np.dtype(np.uint16)}:
            light, saturated, full = self._of_camera(image, self._dark)
        else:
            light = _finite(image, name)
            light -= self._dark if self._dark is not None else np.float32(np.percentile(light, _BACKGROUND_PERCENT))
            is_integer = np.issubdtype(image.dtype, np.integer) and math.isfinite(self._full_scale)
            # Comparing integers with a float takes seven times as long.
            saturated = np.asarray(image >= (math.ceil(self._full_scale) if is_integer else self._full_scale))
            full = int(np.count_nonzero(saturated))
        if full > _SATURATED_FRACTION * image.size:
            raise ReconstructionError(
                f"the {name} is saturated: shorten the exposure or lower the light's current", image=name
            )
        return light, saturated

    def _of_camera(self, image: Counts, dark: Image) -> tuple[Image, Mask, int]:
        """Light, saturated pixels and their number of an image of few bits, four times as fast as with NumPy."""
        light, saturated = np.empty(image.shape, np.float32), np.empty(image.shape, np.bool_)
        pixels: NDArray[Any] = np.ascontiguousarray(image).view()
        pixels.setflags(write=False)  # as frames are: so that one kind is compiled
        least = math.ceil(min(max(self._full_scale, 0.0), 2.0**16))
        return light, saturated, _subtract(pixels, dark, np.float32(least), light, saturated)

    def _check(self, image: Counts, name: str) -> None:
        """Raise if an image has the wrong shape or does not hold numbers."""
        if image.ndim != 2 or image.shape != self._shape:
            raise ReconstructionError(
                f"the {name} has {_size(image.shape)} pixels, but the reference has {_size(self._shape)}", image=name
            )
        if not (np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)):
            raise ReconstructionError(f"the {name} holds {image.dtype} values: grey counts are needed", image=name)


@compiled
def _subtract(image: Counts, dark: Image, least: np.float32, light: Image, saturated: Mask) -> int:
    """Subtract the dark, mark the pixels of at least so many counts, and return their number."""
    full: int = 0
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            count = np.float32(image[row, column])
            light[row, column] = count - dark[row, column]
            saturated[row, column] = count >= least
            full += int(count >= least)
    return full


def _finite(image: Counts, name: str) -> Image:
    """Copy an image to float32; raise if a value is not finite."""
    with np.errstate(over="ignore"):  # overflow becomes infinite, which is rejected below
        light = image.astype(np.float32)
    if not np.issubdtype(image.dtype, np.integer) and not np.isfinite(light).all():
        raise ReconstructionError(f"the {name} holds values that are not finite", image=name)
    return light


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape)
