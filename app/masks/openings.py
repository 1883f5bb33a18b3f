"""Openings of a mask as polygons with true edges, with their narrowest opening and gap.

Coordinates are those of the simulator: x to the right and y downwards, as the frame shows them, from the middle of the
field, m. A mask of the simulator's catalogue keeps its proportions when it is drawn in another size.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.errors import InputError
from app.files import check_readable
from reconstruction.arrays import Floats
from reconstruction.geometry import centered_steps
from reconstruction.runtime.opencv import cv2
from simulated_devices.optics.source import OPTIMISED, read_grey_image
from simulated_devices.settings import Source

TOLERANCE_M = 10e-9  # of round openings, which are polygons
_MOST_PIXELS = 512  # along a side of a picture; a chequer of single pixels takes 12 s to write as DXF then
_LEAST_SIZE_M, _MOST_SIZE_M = 2e-6, 0.2  # of the simulator, too


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Openings:
    """Openings of a mask: polygons (corner, xy) that share no more than edges and corners."""

    name: str
    size_m: float  # side of the square that holds the field
    polygons_m: tuple[Floats, ...]
    width_m: float  # of the narrowest opening; in pictures as of `narrowest_px`
    gap_m: float | None  # None: none is narrower than half the size
    touching: int = 0  # corners where openings only touch; they are no gap

    @property
    def area_m2(self) -> float:
        """Area that lets light through, by the shoelace formula."""
        first = np.cumsum([0, *map(len, self.polygons_m)])
        following = np.arange(1, first[-1] + 1)
        following[first[1:] - 1] = first[:-1]
        (x, y), (next_x, next_y) = self._corners_m.T, self._corners_m[following].T
        return float(np.abs(np.add.reduceat(x * next_y - next_x * y, first[:-1])).sum() / 2)

    @property
    def reach_m(self) -> float:
        """Radius of a circle about the middle that contains the square and all openings."""
        return max(self.size_m / math.sqrt(2), float(np.hypot(*self._corners_m.T).max()))

    @property
    def _corners_m(self) -> Floats:
        """Corners (corner, xy) of all polygons, one after another."""
        return np.concatenate(self.polygons_m)


def rectangle(left_m: float, top_m: float, right_m: float, bottom_m: float) -> Floats:
    """Return the corners (corner, xy) of a rectangle with sides along x and y."""
    return np.array([[left_m, top_m], [right_m, top_m], [right_m, bottom_m], [left_m, bottom_m]])


def _round(half_x_m: float, half_y_m: float) -> Floats:
    """Return a polygon (corner, xy) of the same area as an ellipse, and within the tolerance."""
    count = 4 * math.ceil(math.pi / 4 / math.sqrt(2 * TOLERANCE_M / half_x_m))
    angle = np.arange(count) * (2 * math.pi / count)
    outwards = math.sqrt(angle[1] / math.sin(angle[1]))
    return outwards * np.stack([half_x_m * np.cos(angle), half_y_m * np.sin(angle)], axis=-1)


def openings(name: str, source: Source, size_m: float) -> Openings:
    """Return the openings of a mask of the simulator, or of a black-and-white picture of them.

    `source` has the proportions of the simulator's masks, and the file of its mask "image"; `size_m` is the side of the
    square that holds the field, instead of the source's. `InputError` if the mask is grey or unknown, or cannot be made
    in this size.
    """
    if not _LEAST_SIZE_M <= size_m <= _MOST_SIZE_M:
        raise InputError(f"a mask of {size_m * 1e3:g} mm cannot be drawn: choose a size from 2 um to 200 mm")
    known = ", ".join(_CATALOGUE)
    if name == "peaks":
        raise InputError(f"{name} is grey, and lithography makes openings only: choose {known}, or a picture")
    if name in _CATALOGUE:
        return _CATALOGUE[name](source, size_m)
    if name == "image" and not source.file:
        raise InputError("the bench names no picture for the mask image: give the file itself")
    path = Path(source.file if name == "image" else name)
    if not path.exists():
        raise InputError(f"there is no mask and no file {path}: give the file of a picture, or {known}")
    check_readable(path)
    return _of_picture(path, size_m)


def _square(_: Source, size_m: float) -> Openings:
    half_m = size_m / 2
    return _one("square", size_m, size_m, rectangle(-half_m, -half_m, half_m, half_m))


def _ellipse(source: Source, size_m: float) -> Openings:
    width_m = source.ellipse_ratio * size_m
    return _one("ellipse", size_m, width_m, _round(size_m / 2, width_m / 2))


def _octagon(_: Source, size_m: float) -> Openings:
    angle = math.pi / 8 + np.arange(8) * (math.pi / 4)
    corners = np.stack([np.cos(angle), np.sin(angle)], axis=-1) / math.cos(math.pi / 8)
    return _one("octagon", size_m, size_m, corners * (size_m / 2))


def _one(name: str, size_m: float, width_m: float, polygon_m: Floats) -> Openings:
    return Openings(name=name, size_m=size_m, polygons_m=(polygon_m,), width_m=width_m, gap_m=None)


def _stars(source: Source, size_m: float) -> Openings:
    scale = size_m / (2 * source.half_width_m)
    diameter_m, spacing_m = source.pinhole_diameter_m * scale, source.star_spacing_m * scale
    if diameter_m == 0:
        raise InputError("the pinholes of stars have no width: set simulation.source.pinhole_diameter_m")
    across_m, down_m = (centered_steps(count) * spacing_m for count in (source.star_columns, source.star_rows))
    places_m = [(x_m, y_m) for y_m in down_m for x_m in across_m]
    gap_m = spacing_m - diameter_m if len(places_m) > 1 else None
    if gap_m is not None and gap_m <= 0:
        raise InputError("the pinholes of stars overlap: set simulation.source.star_spacing_m above their diameter")
    return Openings(
        name="stars",
        size_m=size_m,
        polygons_m=tuple(_round(diameter_m / 2, diameter_m / 2) + place for place in places_m),
        width_m=diameter_m,
        gap_m=gap_m,
    )


_CATALOGUE: dict[str, Callable[[Source, float], Openings]] = {
    "square": _square,
    "checkerboard": lambda source, size_m: _of_pixels(
        "checkerboard", np.indices(2 * (source.checker_cells,)).sum(axis=0) % 2 == 0, size_m
    ),
    "optimised": lambda _, size_m: _of_pixels("optimised", OPTIMISED, size_m),
    "circle": lambda _, size_m: _one("circle", size_m, size_m, _round(size_m / 2, size_m / 2)),
    "ellipse": _ellipse,
    "octagon": _octagon,
    "stars": _stars,
}


def _of_picture(path: Path, size_m: float) -> Openings:
    try:
        brightness = read_grey_image(path)
    except ValueError as error:
        raise InputError(f"mask: {error}") from error
    levels = np.unique(brightness)
    if len(levels) > 2 or (len(levels) == 2 and levels[0] != 0):
        raise InputError(
            f"{path} is grey ({len(levels)} levels, the darkest {levels[0]:g}), and lithography makes openings only:"
            " give a picture of 0 (opaque) and one other value (open)"
        )
    if max(brightness.shape) > _MOST_PIXELS:
        raise InputError(f"{path} has more than {_MOST_PIXELS} pixels along a side: make the picture smaller")
    return _of_pixels(path.name, brightness > 0, size_m)


def _of_pixels(name: str, is_open: NDArray[np.bool_], size_m: float) -> Openings:
    """Return the openings of square pixels (row, column) whose longer side fills the square."""
    changes = (np.flatnonzero(np.diff(is_open, axis=axis).any(axis=1 - axis)) + 1 for axis in (0, 1))
    step = math.gcd(*is_open.shape, *(int(at) for along in changes for at in along))
    is_open = is_open[::step, ::step]  # the same openings in the least number of pixels
    pixel_m = size_m / max(is_open.shape)
    middle = np.array(is_open.shape)[::-1] / 2
    width_px, gap_px = narrowest_px(is_open), narrowest_px(~is_open, is_cut_off=True)
    four = is_open[:-1, :-1], is_open[:-1, 1:], is_open[1:, 1:], is_open[1:, :-1]  # around each corner
    touches = (four[0] == four[2]) & (four[1] == four[3]) & (four[0] != four[1])
    return Openings(
        name=name,
        size_m=size_m,
        polygons_m=tuple((rectangle(*sides) - middle) * pixel_m for sides in _rectangles(is_open)),
        width_m=(width_px or max(is_open.shape)) * pixel_m,  # which is found at the latest with the picture's side
        gap_m=gap_px and gap_px * pixel_m,
        touching=int(touches.sum()),
    )


def _rectangles(is_open: NDArray[np.bool_]) -> Iterator[tuple[int, int, int, int]]:
    """Yield (left, top, right, bottom) of rectangles of equal runs of open pixels below each other."""
    growing: dict[tuple[int, int], int] = {}
    for row, line in enumerate([*is_open, np.zeros(is_open.shape[1], np.bool_)]):
        edges = np.flatnonzero(np.diff(line.astype(np.int8), prepend=0, append=0))
        runs = [(int(left), int(right)) for left, right in edges.reshape(-1, 2)]
        for left, right in growing.keys() - runs:
            yield left, growing[left, right], right, row
        growing = {run: growing.get(run, row) for run in runs}


def narrowest_px(is_part: NDArray[np.bool_], *, is_cut_off: bool = False) -> int | None:
    """Return the width of the narrowest part of a picture, px; None if that is above about half of it.

    The part is True in the picture (row, column), and continues outside if it `is_cut_off`. The width is the side of
    the least square that, moved about inside, leaves places farther than a quarter of its side unreached. A disc has
    0.5 to 0.8 of its diameter, a slanting line 0.7 to 1 of its width, a pointed end a pixel or a few.
    """
    most = max(1, max(is_part.shape) // (2 if is_cut_off else 1))
    fits, fails = 0, 1
    while not _is_narrow(is_part, fails, is_cut_off=is_cut_off):
        if fails == most:
            return None
        fits, fails = fails, min(most, fails + max(1, fails // 2))
    while fails - fits > 1:
        middle = (fits + fails) // 2
        fits, fails = (fits, middle) if _is_narrow(is_part, middle, is_cut_off=is_cut_off) else (middle, fails)
    return fails


def _is_narrow(is_part: NDArray[np.bool_], side: int, *, is_cut_off: bool) -> bool:
    """Return True if the part has a place where no square a little wider than `side` pixels fits.

    In half pixels every such square has an odd side, 2 side + 1, and a middle.
    """
    halves = is_part.astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1)
    part = np.pad(halves, side + 1, constant_values=int(is_cut_off))
    unfit = (cv2.distanceTransform(part, cv2.DIST_C, 3) <= side).astype(np.uint8)  # as the middle of the square
    if unfit.all():
        return bool(part.any())
    away = cv2.distanceTransform(unfit, cv2.DIST_C, 3)
    return bool((away[part > 0] > side + 2 * (side // 4)).any())
