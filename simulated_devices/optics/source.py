"""Sources: the openings of the mask as weighted points of the collimator's front focal plane.

All masks but the stars share one grid of object_samples x object_samples points from edge to edge of the field's
square, y slowest, so that one measurement matrix serves them all; dark points have area 0. 37 points over 1.2 mm make
36 steps, as in the paper. Points on the edge have half the weight of the others (trapezoidal rule): with equal weights
the square would be 3 % wider.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from reconstruction.arrays import Floats, reading_npy
from reconstruction.geometry import centered_steps
from reconstruction.runtime.opencv import cv2
from simulated_devices.settings import Source

_PEAKS_LOWEST, _PEAKS_HIGHEST = -6.551133332835839, 8.106213589442339
_POINT_STAR_AREA_M2 = math.pi * (25e-6) ** 2
_ROWS_PER_CELL = 64
# The open cells with the least Cramer-Rao bound in real light, among 6 x 6 that do not change when turned by 180
# degrees: evidence/masks.md.
_OPEN = ("##.#.#", "#.....", "..##.#", "#.##..", ".....#", "#.#.##")
OPTIMISED = np.array([[cell == "#" for cell in row] for row in _OPEN])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourcePoints:
    """Mutually incoherent points of the object plane."""

    position_m: Floats  # (point, xy)
    area_m2: Floats  # (point,), the part of the opening that a point represents; light is proportional to it


def source_points(mask: str, source: Source, *, object_samples: int) -> SourcePoints:
    """Return the points of the mask with that name."""
    if mask == "stars":
        return stars(source)
    edges_m = _cell_edges(source, object_samples)
    along_m = np.linspace(-source.half_width_m, source.half_width_m, object_samples)
    y_m, x_m = np.meshgrid(along_m, along_m, indexing="ij")
    area_m2 = _ON_THE_GRID[mask](source, object_samples) * np.outer(np.diff(edges_m), np.diff(edges_m))
    return SourcePoints(position_m=np.stack([x_m.ravel(), y_m.ravel()], axis=-1), area_m2=area_m2.ravel())


def _square(_source: Source, object_samples: int) -> Floats:
    """Square opening; all areas add up to that of the square."""
    return np.ones((object_samples, object_samples))


def _checkerboard(source: Source, object_samples: int) -> Floats:
    """Square in `checker_cells` x `checker_cells` cells, every other one lit: the one at lowest x, y is."""
    row, column = np.indices(2 * (source.checker_cells,))
    return _pixels_on_grid(source, ((row + column) % 2 == 0).astype(np.float64), object_samples)


def _optimised(source: Source, object_samples: int) -> Floats:
    """Square in 6 x 6 cells, those of `OPTIMISED` lit; row 0 is at the lowest y."""
    return _pixels_on_grid(source, OPTIMISED.astype(np.float64), object_samples)


def _circle(source: Source, object_samples: int) -> Floats:
    """Circular opening that touches the square's four sides: area pi h^2, h the half width."""
    half_m = source.half_width_m
    return _opening(source, lambda y_m: np.sqrt(half_m**2 - y_m**2), object_samples)


def _ellipse(source: Source, object_samples: int) -> Floats:
    """Elliptic opening with half axes h along x and h times `ellipse_ratio` along y."""
    half_m, ratio = source.half_width_m, source.ellipse_ratio
    return _opening(source, lambda y_m: np.sqrt(np.maximum(0, half_m**2 - (y_m / ratio) ** 2)), object_samples)


def _octagon(source: Source, object_samples: int) -> Floats:
    """Regular octagon, four of its sides on those of the square: area 8 (sqrt(2) - 1) h^2."""
    half_m = source.half_width_m
    return _opening(source, lambda y_m: np.minimum(half_m, math.sqrt(2) * half_m - np.abs(y_m)), object_samples)


def _peaks(_source: Source, object_samples: int) -> Floats:
    """Square with the brightness of MATLAB's `peaks` surface, moved and scaled to reach from 0 to 1.

    peaks(x, y) = 3 (1-x)^2 exp(-x^2 - (y+1)^2) - 10 (x/5 - x^3 - y^5) exp(-x^2 - y^2) - exp(-(x+1)^2 - y^2) / 3 for
    x and y in [-3, 3], here the square's sides (y downwards, as in every image); its values lie between -6.5511
    at (0.228, -1.626), which becomes 0, and 8.1062 at (-0.009, 1.581), which becomes 1.
    """
    along = np.linspace(-3, 3, object_samples)
    y, x = np.meshgrid(along, along, indexing="ij")
    surface = 3 * (1 - x) ** 2 * np.exp(-(x**2) - (y + 1) ** 2)
    surface -= 10 * (x / 5 - x**3 - y**5) * np.exp(-(x**2) - y**2)
    surface -= np.exp(-((x + 1) ** 2) - y**2) / 3
    return np.clip((surface - _PEAKS_LOWEST) / (_PEAKS_HIGHEST - _PEAKS_LOWEST), 0, 1)  # both constants are rounded


def _image(source: Source, object_samples: int) -> Floats:
    """Square with the brightness of the grey image in `source.file`, its brightest point 1.

    The image's longer side fills the square; the rest is dark. Each point gets the mean over its cell of the grid.
    Row 0 is at the lowest y.
    """
    brightness = _pixels_on_grid(source, read_grey_image(Path(source.file)), object_samples)
    return np.asarray(brightness / brightness.max())


def stars(source: Source) -> SourcePoints:
    """Return the array of pinholes, each a disc in seven points, or a single point if the diameter is 0.

    The seven-point rule for a disc of radius r (Abramowitz & Stegun 25.4.61; weights 1/4 at the middle and 1/8 at six
    points on the radius r sqrt(2/3)) is exact up to the fifth degree, enough for a pinhole far below a lenslet's
    resolution. A star of diameter 0 gets the area of the paper's 50 um pinhole, so that the same exposure suits both.
    """
    radius_m = source.pinhole_diameter_m / 2
    if radius_m == 0:
        disc, piece_m2 = np.zeros((1, 2)), np.array([_POINT_STAR_AREA_M2])
    else:
        angle = np.arange(6) * (math.pi / 3)
        ring = math.sqrt(2 / 3) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        disc = np.concatenate([np.zeros((1, 2)), ring]) * radius_m  # (7, xy)
        piece_m2 = np.array([1 / 4] + [1 / 8] * 6) * (math.pi * radius_m**2)
    y_m, x_m = np.meshgrid(
        centered_steps(source.star_rows) * source.star_spacing_m,
        centered_steps(source.star_columns) * source.star_spacing_m,
        indexing="ij",
    )
    center = np.stack([x_m.ravel(), y_m.ravel()], axis=-1)  # (star, xy)
    position = center[:, None, :] + disc[None, :, :]
    return SourcePoints(position_m=position.reshape(-1, 2), area_m2=np.tile(piece_m2, len(center)))


def read_grey_image(path: Path) -> Floats:
    """Brightness (row, column), 0 or more, from an image file.

    TIFF, NPY, PNG or another that OpenCV reads; colours become grey. A bad file raises a `ValueError` of one sentence.
    """
    try:
        pixels = _decoded(path)
    except Exception as error:  # damaged files make tifffile raise anything
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ValueError(f"file = {str(path)!r} is not a readable image: {why}") from error
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.size == 0 or pixels.dtype.kind not in "buif":
        raise ValueError(f"file = {str(path)!r} must hold one grey image (rows x columns)")
    brightness = np.asarray(pixels, np.float64)
    if not np.isfinite(brightness).all() or brightness.min() < 0 or brightness.max() == 0:
        raise ValueError(f"file = {str(path)!r} must hold finite brightness of 0 or more, and not all of it 0")
    return brightness


def _decoded(path: Path) -> NDArray[Any] | None:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        with reading_npy():
            return np.asarray(np.load(path, allow_pickle=False))
    if suffix in {".tif", ".tiff"}:
        return np.asarray(tifffile.imread(path))
    content = np.frombuffer(path.read_bytes(), np.uint8)
    if not content.size:
        raise ValueError("it is empty")
    decoded: NDArray[Any] | None = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if decoded is None:
        raise ValueError("unknown format")
    return decoded


def _cell_edges(source: Source, object_samples: int) -> Floats:
    """Edges of the points' cells along one axis, (object_samples + 1,), m; the outer cells are half."""
    half_m = source.half_width_m
    along_m = np.linspace(-half_m, half_m, object_samples)
    return np.concatenate([[-half_m], (along_m[1:] + along_m[:-1]) / 2, [half_m]])


def _opening(source: Source, half_chord_m: Callable[[Floats], Floats], object_samples: int) -> Floats:
    """Opening from -half_chord(y) to half_chord(y) along x; empty where that is 0 or less.

    A point's brightness is the open part of its cell: exact along x, in thin rows along y.
    """
    edges_m = _cell_edges(source, object_samples)
    fraction = (np.arange(_ROWS_PER_CELL) + 0.5) / _ROWS_PER_CELL
    y_m = edges_m[:-1, None] + np.diff(edges_m)[:, None] * fraction  # (cell row, thin row)
    half_m = np.maximum(half_chord_m(y_m), 0)[..., None]
    inside_m = np.diff(np.clip(edges_m, -half_m, half_m), axis=-1)  # (cell row, thin row, cell column)
    return np.asarray(inside_m.mean(axis=1) / np.diff(edges_m))


def _pixels_on_grid(source: Source, pixels: Floats, object_samples: int) -> Floats:
    """Mean over each point's cell of square pixels (row, column) whose longer side fills the square."""
    pixel_m = 2 * source.half_width_m / max(pixels.shape)
    edges_m = _cell_edges(source, object_samples)
    along_y, along_x = (_overlap_shares(edges_m, count, pixel_m) for count in pixels.shape)
    return np.asarray(along_y @ pixels @ along_x.T)


def _overlap_shares(edges_m: Floats, count: int, pixel_m: float) -> Floats:
    """Share of each cell that each of `count` pixels about the axis covers: (cell, pixel)."""
    pixel_edges_m = centered_steps(count + 1) * pixel_m
    low = np.maximum(edges_m[:-1, None], pixel_edges_m[None, :-1])
    high = np.minimum(edges_m[1:, None], pixel_edges_m[None, 1:])
    return np.asarray(np.maximum(high - low, 0) / np.diff(edges_m)[:, None], np.float64)


_ON_THE_GRID: dict[str, Callable[[Source, int], Floats]] = {  # brightness of the grid's points, (row, column)
    "square": _square,
    "checkerboard": _checkerboard,
    "optimised": _optimised,
    "circle": _circle,
    "ellipse": _ellipse,
    "octagon": _octagon,
    "peaks": _peaks,
    "image": _image,
}
