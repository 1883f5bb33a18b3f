"""Finding the lattice of lenslets in a reference.

Every lenslet images the same thing, so the light of each cell repeats that of its neighbours. The phase of the first
Fourier harmonic over one pitch says how far the light of a cell lies from the cell's middle; what all cells have in
common moves the lattice, how it grows from cell to cell stretches and turns it. A few rounds make all of them vanish.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Floats, Lattice, Sensor, centered_steps, nominal_lattice
from reconstruction.spline import Image, sample, spline_coefficients

_SAMPLES = 32  # across a cell
_ROUNDS = 12
_ALIKE = 0.01  # difference of light below which two blocks of lenslets count as equally lit
_CONTRAST = 1e-3  # of the cells' harmonics over their light; an evenly lit frame has none
_AGREEMENT = 0.7  # of the cells' harmonics, 1 when all point the same way; noise gives about 1 / sqrt(cells)


def find_lattice(reference: NDArray[np.generic], sensor: Sensor) -> Lattice:
    """Find where the sensor's lenslets lie on a reference (row, column), from the pitch the sensor is known to have.

    The subimages of the reference must be symmetric about the lenslet axes on average. Of the lattices that fit, the
    one with the most light is returned, and of those alike the one closest to the frame's middle. Raises
    `ReconstructionError` when the frame shows no lattice.
    """
    rows, columns = reference.shape
    lattice = nominal_lattice(sensor, rows, columns)
    cells = (int(rows / lattice.pitch_px) - 1, int(columns / lattice.pitch_px) - 1)
    too_small = cells[0] < sensor.lenslet_rows - 1 or cells[1] < sensor.lenslet_columns - 1
    if too_small or min(cells) < 2:
        raise ReconstructionError(
            f"{sensor.lenslet_rows} x {sensor.lenslet_columns} lenslets of {lattice.pitch_px:.1f} px do not fit on"
            f" {rows} x {columns} pixels"
        )
    coefficients = spline_coefficients(np.asarray(reference, np.float32))
    harmonics = np.zeros((*cells, 2), np.complex128)
    for _ in range(_ROUNDS):
        harmonics = _harmonics(coefficients, lattice, cells)
        lattice = _improve(lattice, harmonics)
    strength = np.abs(harmonics).sum(axis=(0, 1))
    agreement = float(np.min(np.abs(harmonics.sum(axis=(0, 1))) / np.maximum(strength, 1e-30)))
    contrast = float(strength.min()) / max(float(np.abs(_cell_light(coefficients, lattice, cells)).sum()), 1e-30)
    if not (agreement > _AGREEMENT and contrast > _CONTRAST):
        raise ReconstructionError(
            f"the reference shows no lattice of {sensor.lenslet_pitch_px:.1f} px pitch: was the light on?"
        )
    return _most_light(coefficients, lattice, cells, sensor)


def _harmonics(coefficients: Image, lattice: Lattice, cells: tuple[int, int]) -> NDArray[np.complex128]:
    """First Fourier harmonic of the light of each cell along x and along y: (cell_row, cell_column, xy)."""
    light = _cell_light(coefficients, lattice, cells)
    wave = np.exp(2j * np.pi * centered_steps(_SAMPLES) / _SAMPLES)
    return np.stack([light.sum(axis=2) @ wave, light.sum(axis=3) @ wave], axis=-1)


def _cell_light(coefficients: Image, lattice: Lattice, cells: tuple[int, int]) -> Floats:
    """The light on a grid of samples over each cell: (cell_row, cell_column, sample_row, sample_column)."""
    steps = centered_steps(_SAMPLES) / _SAMPLES
    y = centered_steps(cells[0])[:, None, None, None] + steps[:, None]
    x = centered_steps(cells[1])[:, None, None] + steps
    position_px = lattice.to_camera_px(np.stack(np.broadcast_arrays(x, y), axis=-1) * lattice.pitch_px)
    edge = np.array(coefficients.shape[::-1]) - 1
    return sample(coefficients, np.clip(position_px, 0, edge))[0]


def _improve(lattice: Lattice, harmonics: NDArray[np.complex128]) -> Lattice:
    """Move, stretch and turn the lattice by what the harmonics' phases have in common."""
    to_pitches = 1 / (2 * np.pi)
    move = np.angle(harmonics.sum(axis=(0, 1))) * to_pitches * lattice.pitch_px
    along_columns = np.angle((harmonics[:, 1:] * harmonics[:, :-1].conj()).sum(axis=(0, 1))) * to_pitches
    along_rows = np.angle((harmonics[1:] * harmonics[:-1].conj()).sum(axis=(0, 1))) * to_pitches
    center_x_px, center_y_px = lattice.to_camera_px(move)
    return replace(
        lattice,
        center_x_px=float(center_x_px),
        center_y_px=float(center_y_px),
        pitch_px=lattice.pitch_px * (1 + float(along_columns[0] + along_rows[1]) / 2),
        rotation_rad=lattice.rotation_rad + float(along_columns[1] - along_rows[0]) / 2,
    )


def _most_light(coefficients: Image, lattice: Lattice, cells: tuple[int, int], sensor: Sensor) -> Lattice:
    """Of the lattice's cells, choose the block of the sensor's lenslets that holds the most light."""
    wanted = np.array([sensor.lenslet_columns, sensor.lenslet_rows])
    half_cell = np.mod(np.array(cells[::-1]) - wanted, 2) / 2  # an even block has a cell's edge in its middle
    corner = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * wanted / 2 * lattice.pitch_px
    last = np.array(coefficients.shape[::-1]) - 1
    candidates: list[tuple[float, float, Lattice]] = []
    for shift in np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2):
        center_px = lattice.to_camera_px((shift + half_cell) * lattice.pitch_px)
        candidate = replace(lattice, center_x_px=float(center_px[0]), center_y_px=float(center_px[1]))
        outline_px = candidate.to_camera_px(corner)
        if np.all(outline_px > -1.5) and np.all(outline_px < last + 1.5):
            light = float(_cell_light(coefficients, candidate, (int(wanted[1]), int(wanted[0]))).mean())
            candidates.append((light, float(np.hypot(*(center_px - last / 2))), candidate))
    if not candidates:
        raise ReconstructionError("the lattice of the reference does not lie wholly on the frame: move the camera")
    most = max(light for light, _, _ in candidates)
    alike = [candidate for candidate in candidates if candidate[0] >= most - _ALIKE * abs(most)]
    return min(alike, key=lambda candidate: candidate[1])[2]
