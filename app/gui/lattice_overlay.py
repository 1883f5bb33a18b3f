"""Line segments drawn over the camera image, in camera pixels.

Each function returns pairs of rows (end, xy), so that one curve item draws all its segments.
"""

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.geometry import Lattice, centered_steps

_INSET = 0.44  # half the side of a lost lenslet's box, in pitches
_HEAD = 0.35  # length of an arrow's head, in arrow lengths
_BARBS = np.array([[[-0.9, 0.45], [-0.45, -0.9]], [[-0.9, -0.45], [0.45, -0.9]]])  # turn and shorten the shaft


def lattice_lines(lattice: Lattice, lenslet_rows: int, lenslet_columns: int) -> Floats:
    """Return the borders of all cells, each line once."""
    x = centered_steps(lenslet_columns + 1)
    y = centered_steps(lenslet_rows + 1)
    vertical = [[(along, y[0]), (along, y[-1])] for along in x]
    horizontal = [[(x[0], along), (x[-1], along)] for along in y]
    return lattice.to_camera_px(np.array(vertical + horizontal).reshape(-1, 2) * lattice.pitch_px)


def lost_boxes(lattice: Lattice, is_lost: NDArray[np.bool_]) -> Floats:
    """Return a crossed box in the cell of every lost lenslet (lenslet_row, lenslet_column)."""
    row, column = np.nonzero(is_lost)
    middle = np.stack([centered_steps(is_lost.shape[1])[column], centered_steps(is_lost.shape[0])[row]], axis=-1)
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * _INSET
    box = corners[[0, 1, 1, 2, 2, 3, 3, 0, 0, 2, 1, 3]]
    return lattice.to_camera_px((middle[:, None] + box).reshape(-1, 2) * lattice.pitch_px)


def cell_border(lattice: Lattice, lenslets: tuple[int, int], at: tuple[int, int]) -> Floats:
    """Return the border of the cell of one lenslet (row, column)."""
    middle = centered_steps(lenslets[1])[at[1]], centered_steps(lenslets[0])[at[0]]
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    return lattice.to_camera_px((middle + corners[[0, 1, 1, 2, 2, 3, 3, 0]]) * lattice.pitch_px)


def arrows(lattice: Lattice, displacement_px: Floats, magnification: float) -> Floats:
    """Return an arrow from every lenslet's centre along its displacement (lenslet_row, lenslet_column, xy), px.

    Lenslets without a displacement (NaN) have no arrow.
    """
    y, x = np.meshgrid(*(centered_steps(count) for count in displacement_px.shape[:2]), indexing="ij")
    known = np.isfinite(displacement_px).all(axis=-1)
    tail = np.stack([x, y], axis=-1)[known] * lattice.pitch_px
    shaft = displacement_px[known] * magnification
    tip = tail + shaft
    barbs = tip + _HEAD * shaft @ _BARBS
    return lattice.to_camera_px(np.stack([tail, tip, tip, barbs[0], tip, barbs[1]], axis=1).reshape(-1, 2))


def arrow_length_px(displacement: Displacement) -> float:
    """Return the length of all but the longest few mean displacements; NaN if no lenslet is valid."""
    length_px = np.linalg.norm(displacement.mean[displacement.valid], axis=-1)
    return float(np.percentile(length_px, 98)) if length_px.size else float("nan")


def lenslet_at(lattice: Lattice, shape: tuple[int, int], x_px: float, y_px: float) -> tuple[int, int] | None:
    """Return row and column of the lenslet whose cell holds a camera pixel, if any."""
    x, y = lattice.from_camera_px(np.array([x_px, y_px])) / lattice.pitch_px
    row, column = int(np.floor(y + shape[0] / 2)), int(np.floor(x + shape[1] / 2))
    return (row, column) if 0 <= row < shape[0] and 0 <= column < shape[1] else None
