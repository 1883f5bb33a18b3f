"""Space-variant blur of an image and its adjoint, from the wavefronts at its field positions.

The image is cut into tiles. Within a tile, the point-spread function of a pixel is interpolated between nodes by
polynomials. A singular value decomposition writes it as the mean over the nodes plus a few others, each with a smooth
weight over the tile:
h(x) = p_0 + sum_k w_k(x) p_k. So the blurred tile is a sum of convolutions. All p_k but the mean have sum 0, so light
is conserved whatever is left out.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from reconstruction.arrays import Floats
from reconstruction.modes.field_modes import SampledModes
from reconstruction.runtime.threads import in_threads

PsfAt = Callable[[float, float], Floats]
"""Point-spread function (2 reach + 1, 2 reach + 1) of the image position x, y, px; sum 1."""
Values = NDArray[np.floating]
"""Light of an image or of an object, (row, column), in any unit."""

_SIDES_PX = range(64, 1025, 32)  # of a tile
_NODES = range(3, 9)  # along a side of a tile
_NODE_STEP_RAD = 0.7  # RMS change of the wavefront from node to node
_TOLERANCE = 0.01  # RMS of what the expansion leaves out, relative to the point-spread functions


@dataclass(frozen=True, slots=True, eq=False)
class _Tile:
    """Part of the object with its expansion; its light reaches farther by the reach on every side."""

    rows: slice  # of the object
    columns: slice
    lit: tuple[slice, slice]  # rows and columns of its light, counted from one reach before the object
    fft_shape: tuple[int, int]
    spectra: NDArray[np.complexfloating]  # of p_k, (term, row, column)
    weights: Values  # w_k without that of the mean, which is 1: (term - 1, row, column)

    def blur(self, scene: Values) -> Values:
        """Light of this part of an object (row, column), on the pixels `lit`."""
        part = scene[self.rows, self.columns]
        spectrum = self.spectra[0] * fft.rfft2(part, self.fft_shape)
        for transfer, weight in zip(self.spectra[1:], self.weights, strict=True):
            spectrum += transfer * fft.rfft2(part * weight, self.fft_shape)
        rows, columns = (each.stop - each.start for each in self.lit)
        return np.asarray(fft.irfft2(spectrum, self.fft_shape, overwrite_x=True)[:rows, :columns])

    def adjoint(self, light: Values) -> Values:
        """Adjoint of `blur`."""
        rows, columns = (each.stop - each.start for each in (self.rows, self.columns))
        spectrum = fft.rfft2(light[self.lit], self.fft_shape)

        def seen(transfer: NDArray[np.complexfloating]) -> Values:
            part = fft.irfft2(spectrum * transfer.conj(), self.fft_shape, overwrite_x=True)
            return np.asarray(part[:rows, :columns])

        total = seen(self.spectra[0])
        for transfer, weight in zip(self.spectra[1:], self.weights, strict=True):
            total += weight * seen(transfer)
        return total


class SpaceVariantBlur:
    """Space-variant blur of an object, and its adjoint; prepared once.

    The object is larger than the image by the reach on every side, because light from beyond the edge arrives, too.

    Parameters
    ----------
    shape : (rows, columns)
        Of the image.
    reach_px : int
        Half the width of the point-spread functions.
    known_px : ((y_least, y_most), (x_least, x_most))
        Part of the image with known point-spread functions; beyond it they are those of the nearest position in it.
    change_rad_per_px : float
        RMS change of the wavefront over the image; sets tiles and nodes.
    dtype
        Of all computations.
    progress : callable
        Receives the share of the tiles that are prepared.
    """

    def __init__(
        self,
        psf_at: PsfAt,
        shape: tuple[int, int],
        *,
        reach_px: int,
        known_px: tuple[tuple[float, float], tuple[float, float]],
        change_rad_per_px: float,
        dtype: type[np.float32 | np.float64] = np.float32,
        progress: Callable[[float], None] = lambda _: None,
    ) -> None:
        self.shape, self.reach_px, self._dtype = shape, reach_px, dtype
        self.object_shape = shape[0] + 2 * reach_px, shape[1] + 2 * reach_px
        self._tiles: list[_Tile] = []
        sides_px = [_side_px(length, reach_px, change_rad_per_px) for length in self.object_shape]
        parts = [
            [slice(first, min(first + side, length)) for first in range(0, length, side)]
            for side, length in zip(sides_px, self.object_shape, strict=True)
        ]
        wanted = math.ceil(max(sides_px) * change_rad_per_px / _NODE_STEP_RAD) + 1
        nodes = min(max(wanted, _NODES[0]), _NODES[-1])
        for done, (rows, columns) in enumerate(product(*parts), 1):
            y, nodes_y = self._positions(rows, known_px[0], nodes)
            x, nodes_x = self._positions(columns, known_px[1], nodes)
            kernels = np.stack([psf_at(float(at_x), float(at_y)) for at_y in nodes_y for at_x in nodes_x])
            terms, node_weights = _expansion(kernels)
            origin = np.zeros(1)
            along_y = SampledModes(origin, nodes_y).values(0.0, y)
            along_x = SampledModes(nodes_x, origin).values(x, 0.0)
            weights = along_y.T @ node_weights.reshape(-1, nodes, nodes) @ along_x
            lit = slice(rows.start, rows.stop + 2 * reach_px), slice(columns.start, columns.stop + 2 * reach_px)
            fft_rows, fft_columns = (fft.next_fast_len(each.stop - each.start, real=True) for each in lit)
            fft_shape = fft_rows, fft_columns
            spectra = fft.rfft2(terms.astype(dtype), fft_shape)
            self._tiles.append(_Tile(rows, columns, lit, fft_shape, spectra, weights.astype(dtype)))
            progress(done / (len(parts[0]) * len(parts[1])))

    def __call__(self, scene: Values) -> Values:
        """Image (row, column) of an object (row, column)."""
        light = np.zeros([length + 2 * self.reach_px for length in self.object_shape], self._dtype)
        parts = in_threads(lambda tile: tile.blur(scene), self._tiles)
        for tile, part in zip(self._tiles, parts, strict=True):
            light[tile.lit] += part
        margin = 2 * self.reach_px
        return light[margin : margin + self.shape[0], margin : margin + self.shape[1]]

    def adjoint(self, image: Values) -> Values:
        """Adjoint of the blur: an object (row, column) from an image (row, column)."""
        light = np.pad(image, 2 * self.reach_px)
        scene = np.empty(self.object_shape, self._dtype)
        parts = in_threads(lambda tile: tile.adjoint(light), self._tiles)
        for tile, part in zip(self._tiles, parts, strict=True):
            scene[tile.rows, tile.columns] = part
        return scene

    def _positions(self, part: slice, known_px: tuple[float, float], nodes: int) -> tuple[Floats, Floats]:
        """Nearest known image positions of a part of the object along one axis, and nodes between them."""
        at = np.clip(np.arange(part.start, part.stop) - float(self.reach_px), *known_px)
        middle, half = (at[0] + at[-1]) / 2, max((at[-1] - at[0]) / 2, 0.5)
        return at, middle - half * np.cos(np.pi * np.arange(nodes) / (nodes - 1))  # extrema of Chebyshev's polynomials


def _expansion(kernels: Floats) -> tuple[Floats, Floats]:
    """Mean of kernels (node, row, column) and their changes, (term, row, column), with weights (node, term - 1)."""
    mean = kernels.mean(axis=0)
    changes = (kernels - mean).reshape(len(kernels), -1)
    energy, vectors = np.linalg.eigh(changes @ changes.T)  # in increasing order
    vectors = vectors[:, np.cumsum(np.maximum(energy, 0)) > _TOLERANCE**2 * np.sum(kernels**2)]
    principal = (vectors.T @ changes).reshape(-1, *mean.shape)
    return np.concatenate([mean[None], principal]), vectors.T


def _side_px(length_px: int, reach_px: int, change_rad_per_px: float) -> int:
    """Side of the tiles along an axis of the object that costs least.

    The area of the transforms grows with the margins of small tiles, the number of terms with the wavefront's change
    over large ones; 3 + 0.9 change^2 was seen, with the change in rad.
    """

    def cost(side: int) -> float:
        return (1 + 2 * reach_px / side) ** 2 * (3 + 0.9 * (side * change_rad_per_px) ** 2)

    count = -(-length_px // min(_SIDES_PX, key=cost))
    return -(-length_px // count)
