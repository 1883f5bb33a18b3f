"""Frames of spots in closed form: Gaussians at given places, integrated over the pixels, with photon noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from reconstruction.arrays import Floats

PITCH_PX, SIGMA_PX, SIDE_PX = 30.0, 2.2, 512


def hexagonal_centers_px(
    *, angle_deg: float, radius_px: float = 200.0, pitch_px: float = PITCH_PX, middle_px: float = (SIDE_PX - 1) / 2
) -> Floats:
    """Points (N, xy) of a hexagonal lattice inside a circle about one of them; at 0 degrees, rows lie along x."""
    steps = np.arange(-40, 41)
    n, m = (each.ravel() for each in np.meshgrid(steps, steps))
    points = pitch_px * (n + m * np.exp(1j * np.pi / 3)) * np.exp(1j * np.radians(angle_deg))
    points = points[np.abs(points) < radius_px]
    return np.stack([points.real, points.imag], axis=-1) + middle_px


def square_centers_px(*, angle_deg: float, pitch_px: tuple[float, float] = (PITCH_PX, PITCH_PX)) -> Floats:
    """Points (N, xy) of a square lattice, of other pitches along its x and y if need be, that fill a frame."""
    steps = np.arange(-30, 31)
    n, m = (each.ravel() for each in np.meshgrid(steps, steps))
    points = (pitch_px[0] * n + 1j * pitch_px[1] * m) * np.exp(1j * np.radians(angle_deg))
    return np.stack([points.real, points.imag], axis=-1) + (SIDE_PX - 1) / 2


def spots(
    centers_px: Floats,
    *,
    shape: tuple[int, int] = (SIDE_PX, SIDE_PX),
    sigma_px: float = SIGMA_PX,
    peak: float = 3000.0,
    background: float = 100.0,
    seed: int = 0,
) -> NDArray[np.uint16]:
    """Counts of a frame with Poisson noise; `peak` is that of a spot, above the background."""
    along = [
        np.diff(erf((np.arange(length + 1) - 0.5 - centers_px[:, axis, None]) / (np.sqrt(2) * sigma_px)), axis=1) / 2
        for axis, length in enumerate(shape[::-1])
    ]
    light = peak * 2 * np.pi * sigma_px**2 * along[1].T @ along[0]
    return np.asarray(np.random.default_rng(seed).poisson(light + background), np.uint16)


def near(found_px: Floats, centers_px: Floats) -> Floats:
    """Distance of each point (N, xy) from the nearest of the others, px, (N,)."""
    return np.asarray(np.hypot(*np.moveaxis(found_px[:, None] - centers_px, -1, 0)).min(axis=1))
