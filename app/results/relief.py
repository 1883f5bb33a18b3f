"""Contours and projected surface of a map."""

import math
from dataclasses import dataclass

import contourpy
import numpy as np

from reconstruction.arrays import Floats

_MOST_CONTOURS = 16
_LIGHT = (-0.4, 0.5, 0.77)  # direction to the light over the surface, unit length
_AMBIENT = 0.55  # brightness of a face turned away from the light


def contours(values: Floats, limit: float) -> list[Floats]:
    """Return the contours (point, xy) of a map (row, column), in columns and rows; none around unknown values.

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
    least = 2 * limit / _MOST_CONTOURS
    decade = 10.0 ** math.floor(math.log10(least))
    return next(step * decade for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= least * (1 - 1e-9))


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Faces of a surface in orthographic projection, the farthest first."""

    corners: Floats  # x to the right, y down, (face, corner, xy); a base of width 1 is centred on 0
    values: Floats  # mean of the corners' values, (face,)
    brightness: Floats  # 0 ... 1, (face,)


def project_surface(values: Floats, limit: float, *, azimuth_rad: float, elevation_rad: float) -> Surface:
    """Project a map (row, column) as a surface of height values / (4 limit) over a base of width 1.

    Faces with an unknown corner are left out.

    Parameters
    ----------
    values : (row, column)
        NaN where unknown.
    limit : float
        Value a quarter of the base's width high.
    azimuth_rad : float
        Turn of the base; at 0 columns run to the right and rows towards the viewer.
    elevation_rad : float
        Of the viewer above the base: pi/2 looks straight down.
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
    cosine, sine = math.cos(azimuth_rad), math.sin(azimuth_rad)
    turned_x = cosine * face[..., 0] - sine * face[..., 1]
    turned_y = sine * face[..., 0] + cosine * face[..., 1]
    raised, flat = math.cos(elevation_rad), math.sin(elevation_rad)
    corners = np.stack([turned_x, flat * turned_y - raised * face[..., 2]], axis=-1)
    nearness = raised * turned_y.mean(axis=1) + flat * face[..., 2].mean(axis=1)
    order = np.argsort(nearness, kind="stable")
    light = np.clip(normal @ np.array(_LIGHT), 0, 1)
    return Surface(corners[order], mean[order], (_AMBIENT + (1 - _AMBIENT) * light)[order])
