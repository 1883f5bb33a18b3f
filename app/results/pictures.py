"""Pixels and shapes of pictures: colours, enlarged maps, contours and surfaces."""

import math
from dataclasses import dataclass
from typing import TypeAlias

import contourpy
import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats

_MOST_CONTOURS = 16
_LIGHT = (-0.4, 0.5, 0.77)  # direction to the light over the surface, unit length
_AMBIENT = 0.55  # brightness of a face turned away from the light

Pixels: TypeAlias = NDArray[np.uint32]  # 0xAARRGGBB; 0 is transparent


def enlarged(maps: Pixels, rows: int, columns: int, *, is_smooth: bool) -> Pixels:
    """Enlarge each map (view_row, view_column, row, column), by linear interpolation if smooth.

    Qt would do it in threads of its own, and keep Python's lock until they end.
    """
    maps = np.ascontiguousarray(maps)
    found = np.empty((*maps.shape[:2], rows, columns), np.uint32)
    how = cv2.INTER_LINEAR if is_smooth else cv2.INTER_NEAREST_EXACT
    for view in np.ndindex(maps.shape[:2]):
        small, large = (each[view][..., None].view(np.uint8) for each in (maps, found))
        cv2.resize(small, (columns, rows), dst=large, interpolation=how)
    return found


def contours(values: Floats, limit: float) -> list[Floats]:
    """Return contours (point, xy) in columns and rows of a map; none around unknown values.

    Levels are multiples of 1, 2 or 5 times a power of ten; at most 16 steps lie between -limit and +limit.
    """
    if min(values.shape) < 2 or not limit > 0:
        return []
    step = contour_step(limit)
    generator = contourpy.contour_generator(z=np.ma.masked_invalid(values))
    known = values[np.isfinite(values)]
    if not known.size:
        return []
    levels = np.arange(math.ceil(known.min() / step), math.floor(known.max() / step) + 1) * step
    return [np.asarray(line, np.float64) for level in levels for line in generator.lines(float(level))]


def contour_step(limit: float) -> float:
    """Return the step between contours."""
    return step_above(2 * limit / _MOST_CONTOURS, (1.0, 2.0, 5.0))


def step_above(value: float, steps: tuple[float, ...]) -> float:
    """Return the least of `steps`, which cover a decade, times a power of ten, that reaches a value."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(step * decade for step in (*steps, 10.0) if step * decade >= value * (1 - 1e-9))


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Faces of a surface in orthographic projection, the farthest first."""

    corners: Floats  # x to the right, y down, (face, corner, xy); a base of width 1 is centred on 0
    values: Floats  # mean of the corners' values, (face,)
    brightness: Floats  # 0 ... 1, (face,)


def project_surface(values: Floats, limit: float, *, azimuth_rad: float, elevation_rad: float) -> Surface:
    """Project a map (row, column) as a surface of height values / (4 limit) over a base of width 1.

    Faces with an unknown corner, NaN, are left out. At azimuth 0 columns run to the right and rows towards the viewer;
    a viewer at the elevation pi/2 looks straight down.
    """
    rows, columns = values.shape
    width = max(rows, columns) - 1
    y, x = np.meshgrid(np.arange(rows) - (rows - 1) / 2, np.arange(columns) - (columns - 1) / 2, indexing="ij")
    points = np.stack([x / width, y / width, values / (4 * limit)], axis=-1)
    face = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], axis=2).reshape(-1, 4, 3)
    mean = np.mean([values[:-1, :-1], values[:-1, 1:], values[1:, 1:], values[1:, :-1]], axis=0).ravel()
    known = np.isfinite(face).all(axis=(1, 2))
    face, mean = face[known], mean[known]
    normal = np.cross(face[:, 2] - face[:, 0], face[:, 3] - face[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    corners = project_points(face, azimuth_rad=azimuth_rad, elevation_rad=elevation_rad)
    turned_y = math.sin(azimuth_rad) * face[..., 0] + math.cos(azimuth_rad) * face[..., 1]
    nearness = math.cos(elevation_rad) * turned_y.mean(axis=1) + math.sin(elevation_rad) * face[..., 2].mean(axis=1)
    order = np.argsort(nearness, kind="stable")
    light = np.clip(normal @ np.array(_LIGHT), 0, 1)
    return Surface(corners[order], mean[order], (_AMBIENT + (1 - _AMBIENT) * light)[order])


def project_points(points: Floats, *, azimuth_rad: float, elevation_rad: float) -> Floats:
    """Project points (..., xyz), as `project_surface` does: x to the right, y down, (..., xy)."""
    x, y, z = np.moveaxis(points, -1, 0)
    turned_x = math.cos(azimuth_rad) * x - math.sin(azimuth_rad) * y
    turned_y = math.sin(azimuth_rad) * x + math.cos(azimuth_rad) * y
    return np.stack([turned_x, math.sin(elevation_rad) * turned_y - math.cos(elevation_rad) * z], axis=-1)
