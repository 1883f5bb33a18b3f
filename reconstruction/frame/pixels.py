"""Light of an image from its counts: dark, nonlinearity; saturated and clipped pixels."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Counts, Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.frame.linearity import LINEAR, Linearity
from reconstruction.frame.noise import UNKNOWN_NOISE, KnownNoise
from reconstruction.runtime.compilation import compiled, inlined

_SATURATED_FRACTION = 0.01  # of the image's pixels; with more, it is rejected
TOO_BRIGHT = "shorten the exposure or lower the light's current"
CLIPPED = 0.01  # share of the pixels, piled up at one highest count, from which on an image is clipped
ON_FRAME = 0.95  # least share of an image's squared gradients on the frame that cuts its cell; with less, it is absent
BACKGROUND_PERCENT = 1.0  # without a dark, this percentile of the counts is the background
PEAK_PERCENT = 99.9  # this one is the peak, so that hot pixels do not count


def require_unsaturated(saturated: int, pixels: int, name: str) -> None:
    """Raise a `ReconstructionError`, which says `name`, if too many of an image's pixels are saturated."""
    if saturated > _SATURATED_FRACTION * pixels:
        raise ReconstructionError(f"the {name} is saturated: {TOO_BRIGHT}", image=name)


@dataclass(frozen=True, slots=True, eq=False)
class KnownCamera:
    """Dark, saturation, nonlinearity and noise of the camera that took the reference and the frames."""

    dark: Counts | None = None  # (row, column); None: the background is the darkest percent of each image
    full_scale: float = math.inf  # count from which on a pixel is saturated
    linearity: Linearity | None = None  # corrected in every image, dark subtracted
    noise: KnownNoise = UNKNOWN_NOISE  # of images so corrected


UNKNOWN_CAMERA = KnownCamera()


class DarkSubtractor:
    """Subtracts the dark from images of one shape, and corrects the nonlinearity."""

    def __init__(self, shape: tuple[int, ...], camera: KnownCamera) -> None:
        self._shape, self._full_scale = shape, np.float32(camera.full_scale)
        self._curve = LINEAR if camera.linearity is None else camera.linearity.curve
        self._dark: Image | None = None
        if camera.dark is not None:
            self._check(camera.dark, "dark")
            self._dark = _finite(camera.dark, "dark").astype(np.float32)
        self._subtracted(compiled_counts(np.zeros(shape, np.uint16)))  # compile now instead of at the first frame

    def __call__(self, image: Counts, name: str) -> tuple[Image, Booleans]:
        """Light of an image (row, column), counts, and its saturated pixels, the same shape.

        `ReconstructionError`, which says `name`, if it has another size, infinite or no grey values, or is saturated.
        """
        self._check(image, name)
        light, saturated, full = self._subtracted(_finite(image, name))
        require_unsaturated(full, image.size, name)
        return light, saturated

    def _subtracted(self, image: NDArray[Any]) -> tuple[Image, Booleans, int]:
        """Light, saturated pixels and their number, four times as fast as with NumPy."""
        light, saturated = np.empty(image.shape, np.float32), np.empty(image.shape, np.bool_)
        dark = self._dark
        if dark is None:
            dark = np.full(image.shape, np.percentile(image, BACKGROUND_PERCENT), np.float32)
        return light, saturated, _subtract(image, dark, self._curve, self._full_scale, light, saturated)

    def _check(self, image: Counts, name: str) -> None:
        """Raise if an image has the wrong shape or does not hold numbers."""
        if image.ndim != 2 or image.shape != self._shape:
            raise ReconstructionError(
                f"the {name} has {_size(image.shape)} pixels, but the reference has {_size(self._shape)}", image=name
            )
        if not (np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)):
            raise ReconstructionError(f"the {name} holds {image.dtype} values: grey counts are needed", image=name)


@inlined
def _light(signal: np.float32, curve: Image) -> np.float32:
    """Light from the signal; see `Linearity.curve`."""
    square, cube, highest, end = curve
    within = min(signal, highest)
    light: np.float32 = within * (np.float32(1) + within * (square + within * cube)) + (signal - within) * end
    return light


@compiled
def _subtract(
    image: Counts, dark: Image, curve: Image, least: np.float32, light: Image, saturated: Booleans
) -> int:  # `curve` as `Linearity.curve` lists it
    """Subtract the dark, correct the nonlinearity, mark and count pixels of at least so many counts."""
    full: int = 0
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            count = np.float32(image[row, column])
            signal = count - dark[row, column]
            light[row, column] = _light(signal, curve)
            saturated[row, column] = count >= least
            full += int(count >= least)
    return full


def compiled_counts(image: Counts) -> NDArray[Any]:
    """Return an image as one of the kinds that are compiled: read-only, as frames are, 8 or 16 bits or float32."""
    kind = image.dtype if image.dtype in {np.dtype(np.uint8), np.dtype(np.uint16)} else np.float32
    with np.errstate(over="ignore"):  # overflow becomes infinite
        pixels = np.ascontiguousarray(image, kind).view()
    pixels.setflags(write=False)
    return pixels


def _finite(image: Counts, name: str) -> NDArray[Any]:
    """`compiled_counts` of an image; raise if a value is not finite."""
    pixels = compiled_counts(image)
    if not np.issubdtype(image.dtype, np.integer) and not np.isfinite(pixels).all():
        raise ReconstructionError(f"the {name} holds values that are not finite", image=name)
    return pixels


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape)


class Samples(NamedTuple):
    """Pixels of lenslets that are looked at, each (lenslet, sample)."""

    pixel: NDArray[np.int32]  # of the flattened frame; a good one of the lenslet in place of a bad one
    good: Image  # 1, or 0 for those replaced
    gap: Image  # 1 between the openings, else 0
    dark: Image  # counts; 0 if unknown
    expected: Image  # counts of the reference


@compiled
def collect(
    frame: Counts, samples: Samples, camera: tuple[np.float32, Image], counts: Counts, signals: Image, sums: Floats
) -> None:
    """Collect all that quality needs of a frame's pixels (pixel,), in one pass.

    `camera`: counts without light beyond the dark, and the curve of `Linearity`. Fills in the `counts` and `signals`,
    counts above the dark, of the samples, and the `sums` over lenslets (2, lenslet): light, and what the gaps have
    more than in the reference.
    """
    background, curve = camera
    for lenslet in range(sums.shape[1]):
        pixel, found, signal = samples.pixel[lenslet], counts[lenslet], signals[lenslet]
        good, gap = samples.good[lenslet], samples.gap[lenslet]
        dark, expected = samples.dark[lenslet], samples.expected[lenslet]
        for n in range(found.size):
            found[n] = frame[np.uint32(pixel[n])]
        total, more = np.float32(0), np.float32(0)
        for n in range(found.size):  # in vectors, unlike the loop above
            count = np.float32(found[n])
            above = count - background - dark[n]
            total += good[n] * _light(above, curve)
            more += gap[n] * (count - expected[n])
            signal[n] = above
        sums[0, lenslet], sums[1, lenslet] = total, more


_PILED_UP = 3.0  # times as many pixels within one scatter of the highest count as within the next one
_BY_CHANCE = 10  # more pixels within that next scatter than seen, where few are
_EDGE, _MOST_EDGE = 6.0, 3.0  # read noises between the lowest and highest clipped pixel; at most so many scatters
_FINEST = 1e-3  # of the highest count, where the scatter is unknown


def clipped_fraction(counts: Counts, *, scatter: float, read_noise: float) -> float:
    """Share of the pixels that are clipped: they pile up at the highest count.

    The image has any shape. A full well may lie below the camera's full scale, and read noise blurs its edge. Light
    without a limit has ever fewer pixels towards its highest count. `scatter` is the standard deviation of the
    brightest pixels if they were not clipped, counts, 0 if unknown; `read_noise` that of what is added after clipping,
    counts. Beyond half the scatter, clipping is missed.
    """
    top = float(counts.max())
    edge = min(_EDGE * read_noise, _MOST_EDGE * scatter)
    is_integer = np.issubdtype(counts.dtype, np.integer)
    step = max(scatter, edge, 1.0 if is_integer else 0.0, _FINEST * abs(top))
    level, lower = top - step, top - 2 * step
    if is_integer:  # comparing them with a float takes much longer
        level, lower = math.floor(level), math.floor(lower)
    piled = int(np.count_nonzero(counts > level))
    return piled / counts.size if is_piled_up(piled, int(np.count_nonzero(counts > lower)) - piled) else 0.0


def is_piled_up(piled: int, below: int) -> bool:
    """True if pixels within a step of the highest count are clipped, by those within the next one."""
    return bool(piled > _PILED_UP * (below + _BY_CHANCE))
