"""Maps of figures."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from app.results.figures import draw_map


def test_map_lies_at_its_positions() -> None:
    """5 x 9 pixels with middles at -2 ... 2 mm along y and -8 ... 8 mm along x reach half a pixel farther."""
    positions_m = {"y": np.linspace(-2e-3, 2e-3, 5), "x": np.linspace(-8e-3, 8e-3, 9)}
    axes = Figure().subplots()
    draw_map(axes, xr.DataArray(np.zeros((5, 9)), positions_m, ("y", "x")), "map", "viridis", (0.0, 1.0))
    np.testing.assert_allclose(axes.images[0].get_extent(), (-9, 9, 2.5, -2.5))
