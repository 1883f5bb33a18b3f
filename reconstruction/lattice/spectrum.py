"""Rough pitch and rotation of a lattice from the spectrum of a frame.

A square lattice has two spectral peaks, one for its rows and one for its columns, a hexagonal one three, 60 degrees
apart. They are searched for together, so that neither noise nor stripes pass for a lattice.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from reconstruction.arrays import Image
from reconstruction.geometry import Arrangement

REACH = 0.16  # relative error of the designed pitch that is searched
_BINNED_PITCH_PX = 12  # pitch after binning; coarser frames would lose the lattice
_FINENESS = 4  # search steps per width of a peak
_PADDING = 2  # zero padding


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak:
    """The lattice with the strongest two or three harmonics."""

    pitch_px: float
    rotation_rad: float  # see `least_rotation_rad`
    strength: tuple[float, ...]  # of its harmonics, over the median

    @property
    def mean_strength(self) -> float:
        """Geometric mean over the harmonics."""
        return math.prod(self.strength) ** (1 / len(self.strength))


def least_rotation_rad(arrangement: Arrangement, rotation_rad: float) -> float:
    """Rotation of a lattice between -45 and 45 degrees, if square, or -15 and 45 degrees, if hexagonal.

    It looks the same after a quarter, or a sixth, of a turn. Neither end of the range is a usual way to mount it.
    """
    period, least = (math.pi / 2, -math.pi / 4) if arrangement == "square" else (math.pi / 3, -math.pi / 12)
    return (rotation_rad - least) % period + least


def strongest_peak(image: Image, pitch_px: float, arrangement: Arrangement = "square") -> Peak:
    """Find the lattice of about `pitch_px` with the strongest spectrum in an image (row, column)."""
    period = 1.0 if arrangement == "square" else math.sqrt(3) / 2  # of the harmonics, in pitches
    binning = max(1, int(pitch_px * period / _BINNED_PITCH_PX))
    light, near_px = _binned(image, binning), pitch_px * period / binning
    amplitude = _amplitude(light, near_px)
    cells = max(light.shape) / near_px
    pitches_px = near_px * np.linspace(1 - REACH, 1 + REACH, int(2 * REACH * _FINENESS * cells) + 8)
    angles = 3 * (int(np.pi / 6 * _FINENESS * cells) + 3)
    angle_rad = (np.arange(2 * angles) / angles - 0.5) * np.pi / 2  # of both harmonics, a quarter turn apart
    frequency = np.stack([np.sin(angle_rad), np.cos(angle_rad)])[:, None] / pitches_px[:, None]  # (row, column)
    frequency = np.where(frequency[1] < 0, -frequency, frequency)  # of a real image, its conjugate
    index = frequency * np.array(_padded(light.shape))[:, None, None]
    strength = ndimage.map_coordinates(amplitude, index, order=1, mode="grid-wrap")
    strength /= max(float(np.median(strength)), float(np.finfo(np.float32).tiny))
    apart = angles if arrangement == "square" else 2 * angles // 3
    harmonics = np.stack([np.roll(strength, -turn, axis=1) for turn in range(0, 2 * angles, apart)])[..., :apart]
    best = np.unravel_index(np.argmax(harmonics.prod(axis=0)), harmonics.shape[1:])
    row_rad = 0.0 if arrangement == "square" else math.pi / 6  # from a harmonic to the nearest row of lenslets
    return Peak(
        pitch_px=float(pitches_px[best[0]]) * binning / period,
        rotation_rad=least_rotation_rad(arrangement, float(angle_rad[best[1]]) - row_rad),
        strength=tuple(float(each) for each in harmonics[:, best[0], best[1]]),
    )


def without_peaks(image: Image) -> Image:
    """Limit each pixel of an image (row, column) to the brightest of its four neighbours, which removes hot pixels.

    A quick substitute for `bad_pixels`.
    """
    edged = np.pad(image, 1, mode="edge")
    edged[0], edged[-1], edged[:, 0], edged[:, -1] = (-np.inf,) * 4
    brightest = np.maximum(edged[:-2, 1:-1], edged[2:, 1:-1])
    np.maximum(brightest, edged[1:-1, :-2], out=brightest)
    np.maximum(brightest, edged[1:-1, 2:], out=brightest)
    return np.asarray(np.minimum(image, brightest))


def _binned(image: Image, binning: int) -> Image:
    """Means over binning x binning pixels; incomplete blocks at the far edges are dropped."""
    rows, columns = (length // binning for length in image.shape)
    blocks = image[: rows * binning, : columns * binning].reshape(rows, binning, columns, binning)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64), np.float32)


def _padded(shape: tuple[int, ...]) -> list[int]:
    return [fft.next_fast_len(_PADDING * length) for length in shape]


def _amplitude(light: Image, pitch_px: float) -> Image:
    """Amplitude spectrum (row, column), zero frequency first, without the background; only the needed columns."""
    repeating = light - ndimage.uniform_filter(light, max(2, round(pitch_px)), mode="mirror")
    for axis, length in enumerate(light.shape):
        fade = np.hanning(length + 2)[1:-1].astype(np.float32)
        repeating *= fade if axis else fade[:, None]
    rows, columns = _padded(light.shape)
    kept = int(columns / (pitch_px * (1 - REACH))) + 2
    return np.asarray(np.abs(fft.fft(fft.rfft(repeating, columns, axis=1)[:, :kept], rows, axis=0)))
