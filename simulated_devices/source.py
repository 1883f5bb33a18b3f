"""What shines: the openings of the mask, as weighted points of the front focal plane of the collimator."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from reconstruction.geometry import Floats, centered_steps
from simulated_devices.settings import Source


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourcePoints:
    """Points of the object plane that emit independently of one another."""

    position_m: Floats  # (point, xy)
    area_m2: Floats  # (point,): the piece of the opening that each point stands for; light is proportional to it


def square(source: Source, *, object_samples: int) -> SourcePoints:
    """Return the square opening as object_samples x object_samples points from edge to edge.

    37 points over 1.2 mm make 36 steps, as in the paper. A point on the edge stands for half the piece of opening that
    one inside does (the trapezoidal rule): with equal weights the square would be 3 % wider than it is, and
    whatever grows along the field would seem 3 % smaller. All areas add up to that of the square.
    """
    along_m = np.linspace(-source.half_width_m, source.half_width_m, object_samples)
    width_m = np.full(object_samples, along_m[1] - along_m[0])
    width_m[[0, -1]] /= 2
    y_m, x_m = np.meshgrid(along_m, along_m, indexing="ij")
    return SourcePoints(
        position_m=np.stack([x_m.ravel(), y_m.ravel()], axis=-1), area_m2=np.outer(width_m, width_m).ravel()
    )


def stars(source: Source) -> SourcePoints:
    """Return the array of pinholes, each a disc of finite diameter in seven points.

    The seven-point rule for a disc of radius r (Abramowitz & Stegun 25.4.61; weights 1/4 at the middle and 1/8 at six
    points on the radius r sqrt(2/3)) integrates polynomials up to the fifth degree exactly; a pinhole is
    much smaller than what a lenslet resolves, so that its blur needs no more.
    """
    radius_m = source.pinhole_diameter_m / 2
    angle = np.arange(6) * (math.pi / 3)
    ring = math.sqrt(2 / 3) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    disc = np.concatenate([np.zeros((1, 2)), ring]) * radius_m  # (7, xy)
    share = np.array([1 / 4] + [1 / 8] * 6)
    y_m, x_m = np.meshgrid(
        centered_steps(source.star_rows) * source.star_spacing_m,
        centered_steps(source.star_columns) * source.star_spacing_m,
        indexing="ij",
    )
    center = np.stack([x_m.ravel(), y_m.ravel()], axis=-1)  # (star, xy)
    position = center[:, None, :] + disc[None, :, :]
    return SourcePoints(
        position_m=position.reshape(-1, 2), area_m2=np.tile(share * (math.pi * radius_m**2), len(center))
    )
