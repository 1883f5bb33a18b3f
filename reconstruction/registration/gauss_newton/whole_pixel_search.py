"""The compiled whole-pixel search: where a lenslet's light has gone when no step leads there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from reconstruction.arrays import Image
from reconstruction.registration.gauss_newton.alignment import FrameData
from reconstruction.registration.gauss_newton.warped_sampling import Scratch, sample_warped
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.runtime.compilation import compiled


class WholePixelSearch(NamedTuple):
    """What is looked for: the middle of the reference's windows, which shifts within reach leave inside the cell."""

    light: Image  # less its mean and over its contrast, (L, rows, columns)
    uv: Image  # normalised positions of a square patch that is `reach` pixels wider on each side, (xy, N)
    scale: tuple[np.float32, np.float32]  # px per unit of u and v, and 0: a shift stretches nothing
    reach: int  # the largest shift, px


def prepare_search(reference: ReferenceSubimages) -> WholePixelSearch:
    """Prepare the search for shifts that leave the field, with half its blur, inside the lenslet's cell."""
    reach = max(int(reference.reach_px - reference.half_width_px), 0)
    width = 2 * int(reference.half_width_px + reference.blur_px / 2) + reference.width % 2
    width = min(width, reference.width - 2 * reach)  # never beyond the window; the patch is the window at most
    inner = slice((reference.width - width) // 2, (reference.width + width) // 2)
    light = reference.light.reshape(-1, reference.width, reference.width)[:, inner, inner]
    light = light - light.mean(axis=(1, 2), keepdims=True)
    light /= np.maximum(light.std(axis=(1, 2), keepdims=True), np.finfo(np.float32).tiny)
    near = np.abs(reference.offset_px).max(axis=1) <= (width - 1) / 2 + reach
    return WholePixelSearch(
        light=light.astype(np.float32),
        uv=np.ascontiguousarray(reference.offset_px[near].T / reference.half_width_px, np.float32),
        scale=(np.float32(reference.half_width_px), np.float32(0.0)),
        reach=reach,
    )


@compiled
def best_shift(frame: FrameData, search: WholePixelSearch, lenslet: int, displacement: Image, scratch: Scratch) -> None:
    """Set the displacement (xy, Q) to the whole-pixel shift at which the frame correlates best with the reference."""
    still = np.zeros((2, 10), np.float32)
    sample_warped(frame.coefficients, still, search.uv, frame.center_px[lenslet], frame.turn, search.scale, scratch)
    template, reach = search.light[lenslet], search.reach
    rows, columns = template.shape
    width = columns + 2 * reach
    patch = scratch.light
    pixels = np.float32(rows * columns)
    best, best_x, best_y = np.float32(0.0), 0, 0
    for shift_y in range(2 * reach + 1):
        for shift_x in range(2 * reach + 1):
            total, power, product = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for row in range(rows):
                first = (row + shift_y) * width + shift_x
                for column in range(columns):
                    value = patch[first + column]
                    total += value
                    power += value * value
                    product += value * template[row, column]
            spread = power - total * total / pixels
            if spread > 0 and product > best * np.sqrt(spread):  # the template has no mean: the patch's does not matter
                best, best_x, best_y = product / np.sqrt(spread), shift_x, shift_y
    displacement[:] = 0
    displacement[0, 0], displacement[1, 0] = best_x - reach, best_y - reach
