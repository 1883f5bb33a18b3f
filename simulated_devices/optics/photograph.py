"""Photographs of flat, incoherent objects through a phase screen.

Every object pixel has its own point-spread function, by a fast Fourier transform of the light in the pupil. They are
computed on a dense grid over the image and interpolated linearly between its nodes.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from reconstruction.arrays import Floats

PupilField = Callable[[Floats, Floats], NDArray[np.complexfloating]]
"""Field of the light, (y, x), at all combinations of pupil positions x and y, m."""

_SMALLEST_TRANSFORM = 256


def true_psf(
    pupil_field: PupilField, *, pixel_rad: float, wavelength_m: float, pupil_width_m: float, reach_px: int
) -> Floats:
    """Point-spread function (2 reach + 1, 2 reach + 1) of a square pupil, sum 1; a positive slope moves it towards +x.

    The pupil is sampled such that the transform has steps of a pixel, `pixel_rad` in angle.
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
    """Mean photons (scene, row, column) of objects (scene, row, column) of photons, dark beyond their edges.

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
        blurred = signal.fftconvolve(near, psf_at(float(x), float(y))[None], axes=(1, 2))
        images[:, y : y + blurred.shape[1], x : x + blurred.shape[2]] += blurred
    first = margin[0] + reach
    return np.maximum(images[:, first : first + rows, first : first + columns], 0)
