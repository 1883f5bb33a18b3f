"""Frames that no bench with a wavefront makes, from a right one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.geometry import Lattice
from reconstruction.quality.verdict import Fault

Light = NDArray[np.float32]


def _half_of_each_cell(light: Light, lattice: Lattice) -> Light:
    row, column = np.indices(light.shape)
    position = lattice.from_camera_px(np.stack([column, row], axis=-1).astype(np.float64)) / lattice.pitch_px
    blocked = np.array(light)
    blocked[(position[..., 0] + 0.5 * (_columns(light, lattice) % 2)) % 1 < 0.5] = 0
    return blocked


def _columns(light: Light, lattice: Lattice) -> int:
    return int(light.shape[1] / lattice.pitch_px)


def _ghost(share: float) -> Callable[[Light, Lattice], Light]:
    def add(light: Light, _: Lattice) -> Light:
        return (1 - share) * light + share * np.roll(light, (6, 9), axis=(0, 1))

    return add


def _moved_while_exposed(light: Light, _: Lattice) -> Light:
    return np.asarray(ndimage.uniform_filter1d(light, 6, axis=1))


def _out_of_focus(light: Light, _: Lattice) -> Light:
    return np.asarray(ndimage.gaussian_filter(light, 1.2))


def _gamma(light: Light, _: Lattice) -> Light:
    return np.asarray(light.max() * (light / light.max()) ** np.float32(0.5))


def _lower_half_shifted(light: Light, _: Lattice) -> Light:
    shifted, middle = np.array(light), len(light) // 2
    shifted[middle:] = np.roll(light[middle:], 1, axis=1)
    return shifted


def _every_second_row_shifted(light: Light, _: Lattice) -> Light:
    shifted = np.array(light)
    shifted[1::2] = np.roll(light[1::2], 1, axis=1)
    return shifted


def _turned(light: Light, _: Lattice) -> Light:
    return np.maximum(ndimage.rotate(light, 1.0, reshape=False, order=3, mode="nearest"), 0)


def _partly_blocked(light: Light, _: Lattice) -> Light:
    blocked = np.array(light)
    blocked[:, : light.shape[1] // 3] = 0
    return blocked


FAULTY: dict[str, tuple[Callable[[Light, Lattice], Light], Fault]] = {
    "half of each cell blocked": (_half_of_each_cell, Fault.MISFIT),
    "10 % ghost": (_ghost(0.1), Fault.MISFIT),
    "30 % ghost": (_ghost(0.3), Fault.MISFIT),
    "motion blur": (_moved_while_exposed, Fault.MISFIT),
    "defocus": (_out_of_focus, Fault.MISFIT),
    "gamma": (_gamma, Fault.MISFIT),
    "every second row shifted": (_every_second_row_shifted, Fault.MISFIT),
    "lower half shifted": (_lower_half_shifted, Fault.SLOPES),
    "turned by 1 degree": (_turned, Fault.SLOPES),
    "a third of the lenslets blocked": (_partly_blocked, Fault.ILLUMINATION),
}
"""What was done to the frame, and the fault that must be found. (A torn frame needs its reference, too.)"""
