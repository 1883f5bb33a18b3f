"""What is drawn over the camera image, as line segments in camera pixels.

Each function returns the ends of its segments, pairs of rows in (end, xy), so that one curve item draws them all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.geometry import Lattice, centered_steps

_INSET = 0.44  # half the side of a lost lenslet's box, in pitches: inside the borders of its cell
_HEAD = 0.35  # length of an arrow's head, in arrow lengths
_BARBS = np.array([[[-0.9, 0.45], [-0.45, -0.9]], [[-0.9, -0.45], [0.45, -0.9]]])  # along, and turned from, the shaft


def lattice_lines(lattice: Lattice, lenslet_rows: int, lenslet_columns: int) -> Floats:
    """Return the borders of all cells, each line once."""
    x = centered_steps(lenslet_columns + 1)
    y = centered_steps(lenslet_rows + 1)
    upright = [[(along, y[0]), (along, y[-1])] for along in x]
    level = [[(x[0], along), (x[-1], along)] for along in y]
    return lattice.to_camera_px(np.array(upright + level).reshape(-1, 2) * lattice.pitch_px)


def lost_boxes(lattice: Lattice, lost: NDArray[np.bool_]) -> Floats:
    """Return a crossed box in the cell of every lenslet that `lost` (lenslet_row, lenslet_column) marks."""
    row, column = np.nonzero(lost)
    middle = np.stack([centered_steps(lost.shape[1])[column], centered_steps(lost.shape[0])[row]], axis=-1)
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * _INSET
    box = corners[[0, 1, 1, 2, 2, 3, 3, 0, 0, 2, 1, 3]]
    return lattice.to_camera_px((middle[:, None] + box).reshape(-1, 2) * lattice.pitch_px)


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
