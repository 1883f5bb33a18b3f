"""A measurement of lenslets whose light is Gaussian, displaced and stretched in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from reconstruction.arrays import Floats
from reconstruction.modes.field_modes import LegendreModes
from support.gui_bench import BENCH, FIELD, LATTICE, SENSOR, make_frame, make_measurement
from support.optics import converged
from support.window_tools import LENSLETS, views

WIDTH_PX = 4.0
HALF_PX = FIELD.half_width_px(SENSOR)
SHIFT_PX, STRETCH = (1.3, -0.8), 0.06


def spots(
    shift_px: tuple[float, float] = (0.0, 0.0),
    stretch: float = 0.0,
    bend_px: float = 0.0,
    *,
    neglect_propagation: bool = False,
) -> Floats:
    """A Gaussian behind each lenslet, moved by shift + stretch * x or by bend * P2(x / h) along x.

    Peak 20000 counts on 500. Its brightness is conserved or, if propagation is neglected, its flux.
    """
    y, x = np.meshgrid(np.arange(300), np.arange(430), indexing="ij")
    position = LATTICE.from_camera_px(np.stack([x, y], axis=-1).astype(np.float64)) / LATTICE.pitch_px
    inside = (position - np.floor(position + 0.5)) * LATTICE.pitch_px - shift_px
    original, area = inside / (1 + stretch), np.full(inside.shape[:2], (1 + stretch) ** 2)
    if bend_px:  # x' = x + bend (1.5 x^2 / h^2 - 0.5), solved for x
        a = 1.5 * bend_px / HALF_PX**2
        area = np.sqrt(np.maximum(1 + 4 * a * (inside[..., 0] + 0.5 * bend_px), 1e-3))
        original[..., 0] = (area - 1) / (2 * a)
    brightness = 1 / area if neglect_propagation else 1.0
    return np.asarray(500 + 20000 * np.exp(-np.sum(original**2, axis=-1) / (2 * WIDTH_PX**2)) * brightness)


def average(mean: Floats) -> Average:
    return Average(mean.astype(np.float32), np.ones(mean.shape, np.float32), 20, 0.02, 1.0, "em")


def inspected(brightness: float = 1.0, bend_px: float = 0.0, *, neglect_propagation: bool = False) -> Measurement:
    """A measurement with that warp: shift and stretch, or a bend of `bend_px`."""
    coefficients = np.zeros((*LENSLETS, 6, 2))
    if bend_px:
        coefficients[:, :, 3, 0] = bend_px
        light = spots(bend_px=bend_px, neglect_propagation=neglect_propagation)
    else:
        coefficients[:, :, 0] = SHIFT_PX
        coefficients[:, :, 1, 0] = coefficients[:, :, 2, 1] = STRETCH * HALF_PX
        light = spots(SHIFT_PX, STRETCH, neglect_propagation=neglect_propagation)
    variance = np.full(coefficients.shape, 0.01**2)
    variance[:, :, 0] = (0.02**2, 0.03**2)
    frame = make_frame(np.rint(500 + brightness * (light - 500)).astype(np.uint16))
    bench = replace(BENCH, field=replace(BENCH.field, neglect_propagation=neglect_propagation))
    calibration = Calibration(
        bench=bench,
        dark=average(np.full((300, 430), 500.0)),
        reference=average(spots()),
        lattice=LATTICE,
        full_scale=65535,
    )
    base = make_measurement(frame.pixels, views())
    registered = converged(LegendreModes(6), coefficients, variance)
    return replace(base, frame=frame, calibration=calibration, registered=registered)
