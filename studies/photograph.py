"""Photographs of flat, incoherent objects through a phase screen.

Every object pixel has its own point-spread function, by a fast Fourier transform of the light in the pupil. They are
computed on a dense grid over the image and interpolated linearly between its nodes. Objects (a resolution target,
cells, stars) have a brightness (row, column) of at most 1.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
import scipy  # which loads its parts when they are used
from numpy.typing import NDArray
from scipy import fft, ndimage

from reconstruction.arrays import Floats

PupilField = Callable[[Floats, Floats], NDArray[np.complexfloating]]
"""Field of the light, (y, x), at all combinations of pupil positions x and y, m."""

_SMALLEST_TRANSFORM = 256


def true_psf(
    pupil_field: PupilField, *, pixel_rad: float, wavelength_m: float, pupil_width_m: float, reach_px: int
) -> Floats:
    """Point-spread function (2 reach + 1, 2 reach + 1) of a square pupil, sum 1.

    A positive slope moves it towards +x. The pupil is sampled such that the transform has steps of a pixel, `pixel_rad`
    in angle.
    """
    size = 2 * fft.next_fast_len(max(2 * reach_px, _SMALLEST_TRANSFORM // 2))
    step_m = wavelength_m / (size * pixel_rad)
    at_m = (np.arange(size) - size // 2) * step_m
    share = np.clip((pupil_width_m / 2 - np.abs(at_m)) / step_m + 0.5, 0, 1)  # of a sample that lies in the pupil
    lit = slice(*np.flatnonzero(share)[[0, -1]] + [0, 1])
    inner_m = np.clip(at_m[lit], -pupil_width_m / 2, pupil_width_m / 2)
    field = np.zeros((size, size), np.complex128)
    field[lit, lit] = share[lit] * share[lit, None] * pupil_field(inner_m, inner_m)
    light = np.abs(fft.fftshift(fft.fft2(fft.ifftshift(field)))) ** 2
    middle = slice(size // 2 - reach_px, size // 2 + reach_px + 1)
    return np.asarray(light[middle, middle] / light[middle, middle].sum())


def photographs(scenes: Floats, psf_at: Callable[[float, float], Floats], *, spacing_px: int) -> Floats:
    """Mean photons of objects, both (scene, row, column), which are dark beyond their edges.

    `psf_at(x_px, y_px)` is the point-spread function of an object pixel; it is asked at every `spacing_px`.
    """
    _, rows, columns = scenes.shape
    tent = 1 - np.abs(np.arange(1 - spacing_px, spacing_px)) / spacing_px
    nodes_y, nodes_x = (np.arange(0, length + spacing_px, spacing_px) for length in (rows, columns))
    margin = spacing_px - 1, 2 * spacing_px
    padded = np.pad(scenes, ((0, 0), margin, margin))
    reach = len(psf_at(0.0, 0.0)) // 2
    images = np.pad(np.zeros_like(padded), ((0, 0), (reach, reach), (reach, reach)))
    for y, x in product(nodes_y, nodes_x):
        near = padded[:, y : y + len(tent), x : x + len(tent)] * (tent * tent[:, None])
        blurred = scipy.signal.fftconvolve(near, psf_at(float(x), float(y))[None], axes=(1, 2))
        images[:, y : y + blurred.shape[1], x : x + blurred.shape[2]] += blurred
    first = margin[0] + reach
    return np.maximum(images[:, first : first + rows, first : first + columns], 0)


_PERIODS_PX = (6, 8, 12, 16)
_STARS = 150  # in the field
_CELLS = 60  # of the tissue


def resolution_target(side: int) -> Floats:
    """Fields of bars, horizontal and vertical in turn, (side, side); periods of 6 to 16 px."""
    y, x = np.indices((side, side))
    cell = side // len(_PERIODS_PX)
    row, column = np.minimum(y // cell, 3), x // cell
    along = np.where(column % 2 == 0, x, y)
    is_bar = along % np.array(_PERIODS_PX)[row] < np.array(_PERIODS_PX)[row] / 2
    margin = cell // 8
    is_field = (np.minimum(y % cell, x % cell) >= margin) & (np.maximum(y % cell, x % cell) < cell - margin)
    return np.where(is_bar & is_field, 1.0, 0.05)


def cells(side: int, generator: np.random.Generator) -> Floats:
    """Ellipses with a bright membrane and nucleus, (side, side)."""
    y, x = np.indices((side, side))
    image = np.full((side, side), 0.1)
    for _ in range(_CELLS):
        center_x, center_y = generator.uniform(0, side, 2)
        length = generator.uniform(0.025, 0.07) * side
        width, turn = length * generator.uniform(0.5, 1), generator.uniform(0, np.pi)
        along = ((x - center_x) * np.cos(turn) + (y - center_y) * np.sin(turn)) / length
        across = ((y - center_y) * np.cos(turn) - (x - center_x) * np.sin(turn)) / width
        radius = np.hypot(along, across)
        image += 0.3 * (radius < 1) + 0.7 * np.exp(-(((radius - 1) / 0.12) ** 2)) + 0.6 * (radius < 0.35)
    smooth = ndimage.gaussian_filter(image, 0.7)
    return np.asarray(smooth / smooth.max())


def star_field(side: int, generator: np.random.Generator) -> Floats:
    """Points of light, a pixel wide, on a faint background, (side, side)."""
    image = np.full((side, side), 2e-3)
    row, column = generator.integers(4, side - 4, (2, _STARS))
    np.add.at(image, (row, column), generator.uniform(2, 20, _STARS))
    smooth = ndimage.gaussian_filter(image, 1.0)
    return np.asarray(smooth / smooth.max())
