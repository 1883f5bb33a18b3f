"""The camera's pixels behind the lenslets, and exact values there of images on a grid."""

import math
from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np

from reconstruction.arrays import Floats, Image
from reconstruction.geometry import Lattice, Sensor


class PixelGrid:
    """Each pixel's position behind the lenslet whose cell holds its centre; pixels outside stay dark."""

    def __init__(
        self,
        sensor: Sensor,
        lattice: Lattice,
        *,
        lenslets: tuple[int, int],
        shape: tuple[int, int],
        aperture: Floats,
        pixel_fill_factor: float,
    ) -> None:
        """Prepare the pixels of a camera of that shape, behind lenslets (rows, columns).

        `aperture` (sample_row, sample_column) is the amplitude of a lenslet's light.
        """
        self._shape, (lenslet_rows, lenslet_columns) = shape, lenslets
        self._samples = pupil_samples = len(aperture)
        period_m = sensor.wavelength_m * sensor.lenslet_focal_length_m * pupil_samples / sensor.aperture_width_m
        angle_per_px = 2 * math.pi * sensor.pixel_pitch_m / period_m
        row, column = np.indices(shape)
        position_px = np.stack([column, row], axis=-1).astype(np.float64)
        cell, local_px, inside = lattice.cells_at(position_px, lenslet_rows, lenslet_columns)
        pixel = np.flatnonzero(inside)
        lenslet = (cell[..., 1] * lenslet_columns + cell[..., 0]).ravel()
        if lattice.arrangement == "hexagonal":  # every second column of the forward model
            lenslet = 2 * lenslet + (cell[..., 1] % 2).ravel()
            lenslet_columns *= 2
        self._pixel = pixel[np.argsort(lenslet[pixel], kind="stable")]  # flat pixel indices, lenslet by lenslet
        self._ends = np.cumsum(np.bincount(lenslet[self._pixel], minlength=lenslet_rows * lenslet_columns))
        self._angle = (local_px.reshape(-1, 2)[self._pixel] * angle_per_px).astype(np.float32)  # (pixel, xy)
        # Light of one lenslet, integrated over a period, is 1 per unit of object weight; a pixel has this share of it.
        self._scale = (sensor.pixel_pitch_m / period_m) ** 2 / np.sum(aperture)
        side = pixel_fill_factor * angle_per_px / (2 * math.pi)
        self._transfer = _pixel_transfer(pupil_samples, side, lattice.rotation_rad)

    def waves(self, images: Image) -> Image:
        """Amplitudes of the waves of images on the 2n x 2n grid, averaged over a pixel.

        From (lenslet_row, lenslet_column, y, x) to (lenslet, y wave, x wave), each the cosines 0 ... n-1 and then the
        sines 1 ... n-1.
        """
        n = self._samples
        analysis = _analysis(n)
        return self._blurred(analysis @ images.reshape(-1, 2 * n, 2 * n) @ analysis.T * self._scale).astype(np.float32)

    def evaluate(
        self, waves: Image, run: Callable[[Callable[[int], None], Iterable[int]], Iterable[None]] = map
    ) -> Image:
        """Images of object points, (point, row, column), from their `waves`, (lenslet, point, y wave, x wave).

        A single lenslet is used for all. `run` maps a function over lenslets, in parallel if wanted.
        """
        images = np.zeros((waves.shape[1], self._shape[0] * self._shape[1]), np.float32)
        bounds = list(pairwise([0, *self._ends]))

        def work(lenslet: int) -> None:
            start, end = bounds[lenslet]
            along_y, along_x = self._waves_at_pixels(start, end)
            values = np.einsum("yp,iyp->ip", along_y, waves[lenslet if len(waves) > 1 else 0] @ along_x)
            images[:, self._pixel[start:end]] = np.maximum(values, 0)  # rounding can leave -1e-7

        list(run(work, range(len(bounds))))
        return images.reshape(-1, *self._shape)

    def _waves_at_pixels(self, start: int, end: int) -> tuple[Image, Image]:
        """Values of the y and the x waves at the pixels start ... end - 1, each (wave, pixel)."""
        order = np.arange(self._samples, dtype=np.float32)[:, None]
        turn_x, turn_y = order * self._angle[start:end, 0], order * self._angle[start:end, 1]  # (order, pixel)
        along_x = np.concatenate([np.cos(turn_x), np.sin(turn_x[1:])])
        along_y = np.concatenate([np.cos(turn_y), np.sin(turn_y[1:])])
        return along_y, along_x

    def _blurred(self, waves: Floats) -> Floats:
        """Average over the pixels' area: multiply each plane wave by the transfer at its own frequency.

        A product of cosines or sines is a sum of the plane waves (m_x, m_y) and (m_x, -m_y); a turned pixel averages
        them differently.
        """
        n = self._samples
        mean, difference = self._transfer
        cosine, sine = slice(0, n), slice(n, None)
        blurred = np.empty_like(waves)
        blurred[:, cosine, cosine] = mean * waves[:, cosine, cosine]
        blurred[:, cosine, cosine][:, 1:, 1:] -= difference[1:, 1:] * waves[:, sine, sine]
        blurred[:, sine, sine] = mean[1:, 1:] * waves[:, sine, sine]
        blurred[:, sine, sine] -= difference[1:, 1:] * waves[:, cosine, cosine][:, 1:, 1:]
        blurred[:, cosine, sine] = mean[:, 1:] * waves[:, cosine, sine]
        blurred[:, cosine, sine][:, 1:] += difference[1:, 1:] * waves[:, sine, cosine][:, :, 1:]
        blurred[:, sine, cosine] = mean[1:] * waves[:, sine, cosine]
        blurred[:, sine, cosine][:, :, 1:] += difference[1:, 1:] * waves[:, cosine, sine][:, 1:]
        return blurred


def _analysis(samples: int) -> Floats:
    """Matrix (2n - 1, 2n) from values on the grid to the amplitudes of cos 0 ... n-1 and sin 1 ... n-1."""
    angle = np.outer(np.arange(samples), np.arange(-samples, samples) + 0.5) * (math.pi / samples)
    analysis = np.concatenate([np.cos(angle), np.sin(angle[1:])]) / samples
    analysis[0] /= 2
    return analysis


def _pixel_transfer(samples: int, cycles_per_pixel: float, rotation_rad: float) -> tuple[Floats, Floats]:
    """Half sum and half difference of a pixel's transfer at (m_x, m_y) and (m_x, -m_y): (m_y, m_x)."""
    m_y, m_x = np.mgrid[:samples, :samples] * cycles_per_pixel
    cosine, sine = math.cos(rotation_rad), math.sin(rotation_rad)

    def transfer(x: Floats, y: Floats) -> Floats:
        return np.asarray(np.sinc(cosine * x - sine * y) * np.sinc(sine * x + cosine * y), np.float64)

    same, mirrored = transfer(m_x, m_y), transfer(m_x, -m_y)
    return (same + mirrored) / 2, (same - mirrored) / 2
