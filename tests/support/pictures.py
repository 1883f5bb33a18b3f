"""Pictures in files and notebooks: what they show, and that they show something."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np
from matplotlib.image import imread

from reconstruction.arrays import Floats


def assert_drawn(path: Path) -> None:
    """Assert that a PNG file decodes, has ten colours or more, and is not nearly all background."""
    pixels = imread(path)[..., :3] @ np.array([1, 256, 65536])
    colours, counts = np.unique(pixels, return_counts=True)
    assert len(colours) >= 10
    assert counts.max() < 0.99 * pixels.size


def html_picture(html: str) -> Floats:
    """Return the picture (row, column, colour) that a notebook shows."""
    (encoded,) = re.findall(r'<img src="data:image/png;base64,([^"]+)">', html)
    found = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    return np.asarray(found[..., ::-1], np.float64)
