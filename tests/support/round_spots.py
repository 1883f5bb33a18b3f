"""Spots of a point source over a round pupil, displaced by a wavefront in closed form, made with NumPy alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

PITCH_PX, RADIUS_PX, SIZE_PX, MIDDLE_PX = 24.0, 118.0, 288, 143.5
PIXEL_M, FOCAL_M, WAVELENGTH_M = 10e-6, 30e-3, 633e-9
RADIUS_M = RADIUS_PX * PIXEL_M
TRUE_RAD = {"defocus": 0.9, "astigmatism at 0\N{DEGREE SIGN}": -0.6, "astigmatism at 45\N{DEGREE SIGN}": 0.35}
"""Unit RMS over the circle. All are of degree 2: their mean slope over a lenslet is that at its centre."""

BENCH = f"""
[sensor]
lenslet_rows = 12
lenslet_columns = 12
lenslet_pitch_m = {PITCH_PX * PIXEL_M}
lenslet_focal_length_m = {FOCAL_M}
wavelength_m = {WAVELENGTH_M}
pixel_pitch_m = {PIXEL_M}
[lattice]
center_x_px = {MIDDLE_PX}
center_y_px = {MIDDLE_PX}
pitch_px = {PITCH_PX}
[field]
collimator_focal_length_m = 0.2
half_width_m = 1e-4
view_rows = 1
view_columns = 1
[reconstruction]
pupil_modes = 15
[pupil]
shape = "circle"
radius_m = {RADIUS_M}
"""


def write_spots(folder: Path, obscuration: float = 0.0) -> tuple[Path, Path, Path]:
    """Write frame, reference and bench; lenslets outside the pupil and in its shadow are dark."""
    along = (np.arange(12) - 5.5) * PITCH_PX
    x_px, y_px = (grid.ravel() for grid in np.meshgrid(along, along))
    share = np.hypot(x_px, y_px) / RADIUS_PX
    lit = (share <= 1) & (share >= obscuration)
    x, y = x_px[lit] / RADIUS_PX, y_px[lit] / RADIUS_PX
    defocus, astigmatism, skew = TRUE_RAD.values()
    slope_x = 4 * np.sqrt(3) * defocus * x + 2 * np.sqrt(6) * (astigmatism * x + skew * y)
    slope_y = 4 * np.sqrt(3) * defocus * y + 2 * np.sqrt(6) * (skew * x - astigmatism * y)
    px_per_slope = FOCAL_M * WAVELENGTH_M / (2 * np.pi) / RADIUS_M / PIXEL_M
    frame, reference, bench = folder / "frame.tif", folder / "reference.tif", folder / "bench.toml"
    for path, scale, seed in ((frame, px_per_slope, 1), (reference, 0.0, 2)):
        rows, columns = np.mgrid[:SIZE_PX, :SIZE_PX] - MIDDLE_PX
        light = np.full((SIZE_PX, SIZE_PX), 100.0)
        for at_x, at_y in zip(x_px[lit] + scale * slope_x, y_px[lit] + scale * slope_y, strict=True):
            light += 5000 * np.exp(-((columns - at_x) ** 2 + (rows - at_y) ** 2) / (2 * 2.0**2))
        tifffile.imwrite(path, np.random.default_rng(seed).poisson(light).astype(np.uint16))
    bench.write_text(BENCH)
    return frame, reference, bench
