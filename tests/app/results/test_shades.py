"""Pixels of pictures, against NumPy's repetition and a straight line."""

import numpy as np
import pytest

from app.results.pictures import enlarged


@pytest.mark.parametrize(("rows", "columns"), [(4, 5), (12, 10), (8, 30)])
def test_maps_are_enlarged_as_they_are(rows: int, columns: int) -> None:
    maps = np.random.default_rng(1).integers(0, 1 << 32, (2, 3, 4, 5), np.uint32)
    expected = maps.repeat(rows // 4, axis=2).repeat(columns // 5, axis=3)
    np.testing.assert_array_equal(enlarged(maps, rows, columns, is_smooth=False), expected)
    np.testing.assert_array_equal(enlarged(maps[::-1, ::-1], rows, columns, is_smooth=False), expected[::-1, ::-1])


def test_each_colour_rises_evenly_in_a_smooth_map() -> None:
    """Opaque, red rising to the right by 20 in a column, green falling downwards by 30 in a row, blue constant."""
    row, column = np.mgrid[:5, :7]
    red, green, blue = 20 * column, 200 - 30 * row, 77 + 0 * row
    maps = np.uint32(255 << 24) + (red << 16) + (green << 8) + blue
    shown = enlarged(maps.astype(np.uint32)[None, None], 50, 70, is_smooth=True)[0, 0]
    at = (np.arange(70) + 0.5) / 10 - 0.5  # middles of the enlarged pixels, in those of the map
    assert set((shown >> 24).ravel()) == {255}
    assert set((shown & 255).ravel()) == {77}
    np.testing.assert_allclose(shown >> 16 & 255, np.tile(20 * at.clip(0, 6), (50, 1)), atol=1)
    np.testing.assert_allclose(shown >> 8 & 255, np.tile(200 - 30 * at[:50, None].clip(0, 4), (1, 70)), atol=1)
