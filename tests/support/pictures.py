"""Check that a picture file is complete and shows something."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.image import imread


def assert_drawn(path: Path) -> None:
    """Assert that a PNG file decodes, has ten colours or more, and is not nearly all background."""
    pixels = imread(path)[..., :3] @ np.array([1, 256, 65536])
    colours, counts = np.unique(pixels, return_counts=True)
    assert len(colours) >= 10
    assert counts.max() < 0.99 * pixels.size
