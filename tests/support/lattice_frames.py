"""Frames of a lattice in closed form: every image is a sum of Gaussians, each integrated over the pixels exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from reconstruction.arrays import Floats
from reconstruction.geometry import Lattice, Sensor
from support.optics import sensor_of

Shape = Literal["square", "disc", "ring", "stars", "pinhole", "corner"]


def sensor_with(rows: int, columns: int, pitch_px: float) -> Sensor:
    """A sensor designed for that pitch."""
    return replace(sensor_of(rows, columns), lenslet_pitch_m=pitch_px * 16e-6)


FRAME = (512, 512)
TRUTH = Lattice(center_x_px=257.3, center_y_px=251.8, pitch_px=31.4, rotation_rad=0.017)
SENSOR = sensor_with(15, 15, 31.25)


def drawn(
    shape: Shape = "square", half_width: float = 0.3, brightness: Floats | None = None, lattice: Lattice = TRUTH
) -> Floats:
    """A frame of 15 x 15 lenslets, or of as many as `brightness` has."""
    return draw(
        FRAME,
        center_px=(lattice.center_x_px, lattice.center_y_px),
        pitch_px=lattice.pitch_px,
        rotation_rad=lattice.rotation_rad,
        brightness=np.ones((15, 15)) if brightness is None else brightness,
        image_px=image_of(shape, lattice.pitch_px, half_width, 1.2),
    )


def image_of(shape: Shape, pitch_px: float, half_width: float, blur_px: float) -> Floats:
    """Positions of the Gaussians of one lenslet's image about its centre, px, (N, xy); `half_width` in pitches."""
    half_px = half_width * pitch_px
    if shape == "pinhole":
        return np.zeros((1, 2))
    if shape == "stars":
        along = np.array([-1.0, 0.0, 1.0]) * half_px
    elif shape == "corner":  # three stars in an L
        return np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0]]) * half_px
    elif shape == "ring":
        angle = np.arange(48) * np.pi / 24
        return half_px * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    else:
        steps = int(np.ceil(2 * half_px / (1.5 * blur_px)))  # so dense that no ripple is left
        along = np.linspace(-half_px, half_px, steps + 1)
    points = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return points[np.hypot(*points.T) <= half_px * 1.0001] if shape == "disc" else points


def draw(
    frame: tuple[int, int],
    *,
    center_px: tuple[float, float],
    pitch_px: float,
    rotation_rad: float,
    brightness: Floats,
    image_px: Floats,
    blur_px: float = 1.2,
    beside_px: Floats | None = None,
) -> Floats:
    """Draw lenslets (row, column) of that brightness about the centre (x, y); the brightest pixel becomes 1.

    `beside_px` (row, column, xy) moves each one's image away from the lattice.
    """
    light = np.zeros(frame)
    turn = np.array([[np.cos(rotation_rad), np.sin(rotation_rad)], [-np.sin(rotation_rad), np.cos(rotation_rad)]])
    rows, columns = brightness.shape
    reach = int(np.abs(image_px).max() * 1.5 + 6 * blur_px) + 2
    for (row, column), amount in np.ndenumerate(brightness):
        middle = np.array([column - (columns - 1) / 2, row - (rows - 1) / 2]) * pitch_px
        if beside_px is not None:
            middle += beside_px[row, column]
        x, y = ((middle + image_px) @ turn + center_px).T
        near = np.rint(middle @ turn + center_px).astype(int)
        left, top = np.maximum(near - reach, 0)
        right, bottom = np.minimum(near + reach, frame[::-1])
        if left < right and top < bottom:
            along_x, along_y = _in_pixels(x, left, right, blur_px), _in_pixels(y, top, bottom, blur_px)
            light[top:bottom, left:right] += amount * along_y.T @ along_x
    return np.asarray(light / light.max())


def _in_pixels(where_px: Floats, first: int, end: int, blur_px: float) -> Floats:
    """Share of Gaussians at those places that falls on each pixel from `first` to `end`, (N, pixel)."""
    edge = np.arange(first, end + 1) - 0.5
    return np.asarray(np.diff(erf((edge - where_px[:, None]) / (np.sqrt(2) * blur_px)), axis=1) / 2)


def photographed(
    light: Floats,
    rng: np.random.Generator,
    *,
    peak_e: float,
    read_noise_e: float = 10.0,
    background_e: Floats | float = 0,
) -> NDArray[np.uint16]:
    """Camera counts: photon and read noise, one count an electron, an offset of 500 counts."""
    electrons = rng.poisson(light * peak_e + background_e) + rng.normal(500, read_noise_e, light.shape)
    return np.clip(electrons, 0, 65535).astype(np.uint16)
