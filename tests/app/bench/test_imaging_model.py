"""Values of the lenslets on the camera."""

from __future__ import annotations

import numpy as np

from app.bench.imaging_model import by_pixel
from reconstruction.geometry import Lattice


def test_each_pixel_has_the_value_of_its_lenslet() -> None:
    """2 x 3 cells of 10 x 10 pixels, from row 12 and column 8 on."""
    values = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    lattice = Lattice(center_x_px=8 + 14.5, center_y_px=12 + 9.5, pitch_px=10)
    expected = np.zeros((40, 50))
    expected[12:32, 8:38] = np.kron(values, np.ones((10, 10)))
    np.testing.assert_array_equal(by_pixel(values, lattice, 40, 50), expected)
