"""The subimages: which pixels of the camera belong to which lenslet, and what the reference shows there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.displacement import Mask, Outcome, Outcomes
from reconstruction.errors import ReconstructionError
from reconstruction.field_modes import FieldModes
from reconstruction.geometry import Field, Floats, Lattice, Sensor, centered_steps, require
from reconstruction.noise import CameraNoise
from reconstruction.spline import Image, sample, spline_coefficients

_OFF_CAMERA_FRACTION = 0.5  # of the lenslets; with more, the lattice belongs to another frame
_DARK_CONTRAST = 0.1  # of the median lenslet's contrast; below it a lenslet counts as unlit
_SMOOTH = 0.2  # correlation of neighbouring pixels below which a reference is noise and no image


class ReferenceSubimages:
    """The reference cut into windows of `width` x `width` pixels about the true sub-pixel centres of L lenslets.

    Windows lie along the lattice's own axes; nothing of the frame is resampled but what lies in them.
    """

    def __init__(
        self,
        reference: Image,
        *,
        sensor: Sensor,
        lattice: Lattice,
        field: Field,
        noise: CameraNoise | None = None,
        reference_frames: float = np.inf,
    ) -> None:
        """Cut `reference` (row, column), counts above the dark; raise `ReconstructionError` if it shows nothing.

        `noise` is that of a single frame, where it is known; the reference is the mean of `reference_frames` frames.
        """
        require({"reference_frames must be at least 1": reference_frames >= 1})
        self.noise, self.reference_frames = noise, reference_frames
        self.lenslets = (sensor.lenslet_rows, sensor.lenslet_columns)
        self._field_outline = field.outline
        self.half_width_px = field.half_width_px(sensor)  # of the field, in a subimage
        # A point's image falls to zero at the distance blur_px.
        blur_px = sensor.wavelength_m * sensor.lenslet_focal_length_m / sensor.lenslet_pitch_m / sensor.pixel_pitch_m
        self.blur_px = blur_px
        self.reach_px = (lattice.pitch_px - blur_px) / 2  # light of a field's edge beyond it meets the next cell
        self.center_px = lattice.lenslet_centers_px(*self.lenslets).reshape(-1, 2)  # (L, xy)
        cosine, sine = np.cos(lattice.rotation_rad), np.sin(lattice.rotation_rad)
        self.turn = np.array([[cosine, sine], [-sine, cosine]])  # row vectors: lattice frame @ turn = camera

        steps = centered_steps(int(lattice.pitch_px))
        self.width = steps.size
        y, x = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
        self.offset_px = np.stack([x, y], axis=-1)  # window positions about the centre, lattice frame, (N, xy)
        position_px = self.center_px[:, None] + self.offset_px @ self.turn
        edge = np.array(reference.shape[::-1]) - 1
        self.off_camera = np.any((position_px < -0.5) | (position_px > edge + 0.5), axis=(1, 2))
        if np.mean(self.off_camera) > _OFF_CAMERA_FRACTION:
            rows, columns = reference.shape
            raise ReconstructionError(
                f"most lenslets lie beside the frame of {rows} x {columns} pixels: check [lattice] and the frame's size"
            )
        self._position_px = np.clip(position_px, 0, edge)
        nearest = np.rint(self._position_px).astype(np.intp)
        self._nearest = nearest[..., 1], nearest[..., 0]

        self.coefficients = spline_coefficients(reference)  # of the whole frame, (row, column)
        self.light, gradient = sample(self.coefficients, self._position_px)  # (L, N)
        self.gradient = gradient @ self.turn.T  # per pixel, lattice frame, (L, N, xy)
        self.contrast = self.light.std(axis=1)  # (L,)
        dark = ~(self.contrast > _DARK_CONTRAST * np.median(self.contrast[~self.off_camera]))
        self.lit = ~dark & ~self.off_camera
        if not self.lit.any() or self._smoothness() < _SMOOTH:
            raise ReconstructionError("the reference shows no light on its lenslets: was the light on?")

    def cut(self, light: Image) -> Floats:
        """Cut another frame (row, column) into the same windows: (L, width, width)."""
        values, _ = sample(spline_coefficients(light), self._position_px)
        return values.reshape(-1, self.width, self.width)

    def judge(
        self,
        displacement: NDArray[np.floating[Any]],
        modes: FieldModes,
        *,
        contrast: NDArray[np.floating[Any]],
        diverged: Mask,
        saturated: Mask,
    ) -> Outcomes:
        """Say what became of each lenslet, (L,).

        displacement (L, xy, Q) in the field modes, px; contrast (L,) of the frame's subimages; diverged (L,), whether
        the method itself found no match; saturated (row, column) pixels of the frame.
        """
        outcome = np.full(len(self.center_px), Outcome.CONVERGED, np.int8)
        displacement = np.where(diverged[:, None, None], 0, displacement)  # a fit that ran away may hold anything
        outcome[self._leaves_cell(displacement, modes)] = Outcome.LEFT_CELL
        outcome[diverged] = Outcome.DIVERGED
        if saturated.any():
            outcome[saturated[self._nearest].any(axis=1)] = Outcome.SATURATED
        outcome[~self.lit | ~(contrast > _DARK_CONTRAST * np.median(contrast[self.lit]))] = Outcome.DARK
        outcome[self.off_camera] = Outcome.OFF_CAMERA
        return outcome

    def _leaves_cell(self, displacement: NDArray[np.floating[Any]], modes: FieldModes) -> Mask:
        """Whether the field's edge is imaged beyond the lenslet's cell, (L,)."""
        x, y = self._field_outline.T
        edge_px = displacement @ modes.values(x, y) + self.half_width_px * np.stack([x, y])
        return np.asarray(np.abs(edge_px).max(axis=(1, 2)) > self.reach_px)

    def _smoothness(self) -> float:
        """Median correlation of horizontally neighbouring pixels in the lit windows: about 0 for pure noise."""
        window = self.light[self.lit].reshape(-1, self.width, self.width)
        window = window - window.mean(axis=(1, 2), keepdims=True)
        neighbours = (window[:, :, 1:] * window[:, :, :-1]).mean(axis=(1, 2))
        return float(np.median(neighbours / (window**2).mean(axis=(1, 2))))
