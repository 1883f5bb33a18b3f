"""Array type aliases shared by the packages."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
Counts = NDArray[np.integer[Any]] | NDArray[np.floating[Any]]
"""Camera frame as read from a camera or a file, (row, column)."""
Mask = NDArray[np.bool_]
