"""Type aliases for the arrays that the packages exchange."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
Counts = NDArray[np.integer[Any]] | NDArray[np.floating[Any]]
"""A camera frame as read from the camera or from a file, (row, column)."""
Mask = NDArray[np.bool_]
