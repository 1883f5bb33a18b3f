"""Subimages of the reference, one per lenslet; classification of lenslets (converged, dark, ...)."""

from collections.abc import Iterable
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Floats, Image, median
from reconstruction.displacement import CovarianceSource, Displacement, LensletStatus
from reconstruction.errors import ReconstructionError, UnusableSettings
from reconstruction.frame.bad_pixels import repaired
from reconstruction.frame.noise import UNKNOWN_NOISE, KnownNoise
from reconstruction.frame.pixels import ON_FRAME
from reconstruction.frame.spline import interpolate, spline_coefficients
from reconstruction.geometry import Field, Lattice, Sensor, centered_steps, require
from reconstruction.modes.field_modes import FieldModes

_OFF_CAMERA_FRACTION = 0.6  # of the lenslets; with more, the lattice does not belong to this frame (turned: 0.5)
_SPOILT = 0.25  # of a subimage's squared gradients on bad pixels or, when it moves, off the frame; more is too much
_RIM_PX = 2  # at the frame's edge, where also positions beyond it are sampled
_NEXT_PX = 2.0  # beyond the border of a cell, where interpolation still uses a pixel
DARK_CONTRAST = 0.1  # of the typical lit lenslet's contrast; with less, a lenslet is absent, or dark in a frame
MISFIT = 0.5  # residual over contrast above which a subimage does not match the reference
_BRIGHT = 3  # rank of a lit lenslet's contrast; higher ones may be stray
_BY_CHANCE = 3  # standard errors of the light that neighbouring pixels share, which noise alone may reach
_SMOOTH = 0.2  # correlation of neighbouring pixels below which a reference is only noise


class LensletModel(Protocol):
    """Forward model of one lenslet with the measured source, on the window of a subimage."""

    position: Floats  # of the object points, normalised, (point, xy)

    def image(self, brightness: Floats | float = 1.0) -> Floats:
        """Image without a sample, (row, column), a share of the light; `brightness` (point,), or one, scales it."""
        ...

    def derivatives(self, degree: int, values: Floats, gradients: Floats, own: tuple[int, int] | None = None) -> Floats:
        """Change of `image` per rad of the wavefronts P_m(xi) P_n(eta) T_q over the lenslet, m + n <= degree.

        From T_q at the object points, (field_mode, point), and its normalised gradients, (field_mode, point, xy), to
        (n, m, field_mode, row, column). With `own`, (n, m) of odd sum, the derivative of that by this wavefront of the
        lenslet, per rad^2.
        """
        ...


class ReferenceSubimages:
    """Windows of `width` x `width` pixels of the reference about the subpixel centres of L lenslets.

    Windows lie along the lattice's axes; only their pixels are resampled.
    """

    def __init__(
        self,
        reference: Image,
        *,
        sensor: Sensor,
        lattice: Lattice,
        field: Field,
        noise: KnownNoise = UNKNOWN_NOISE,
        bad: Booleans | None = None,
        excluded: Iterable[tuple[int, int]] = (),
    ) -> None:
        """Cut `reference` (row, column), counts above the dark; `ReconstructionError` if it shows nothing.

        `bad` (row, column) marks bad pixels. `excluded` are lenslets (row, column) that are left out.
        """
        require({"reference_frames must be at least 1": noise.reference_frames >= 1})
        self.sensor, self.field = sensor, field
        self.noise, self.reference_frames = noise.of_frame, noise.reference_frames
        self.lenslets = sensor.lenslets
        self._field_outline = field.outline
        self._at_outline: dict[FieldModes, Floats] = {}  # field modes there, (Q, position), cached
        self.half_width_px = field.half_width_px(sensor)  # of the field, in a subimage
        self.blur_px = sensor.blur_px
        self.pitch_px = lattice.pitch_px
        self.cell_px = np.array([1.0, lattice.row_spacing]) * np.diag(lattice.pitch_matrix_px)  # its width and height
        self.side_px = float(self.cell_px.min())  # of the square that is looked at
        self.reach_px = (self.side_px - self.blur_px) / 2  # light beyond it reaches the next cell
        if not self.half_width_px < self.reach_px:
            raise ReconstructionError(
                f"the image of the field, {2 * self.half_width_px:.1f} px wide, leaves no space to move in cells of"
                f" {self.side_px:.1f} px, of which blur takes {self.blur_px:.1f} px: lower field.half_width_m"
            )
        self.center_px = lattice.lenslet_centers_px(*self.lenslets).reshape(-1, 2)  # (L, xy)
        self.turn = lattice.turn  # row vectors: lattice frame @ turn = camera
        self.px_per_pitch = lattice.pitch_matrix_px @ lattice.turn  # the same, from pitches

        self.steps_px = centered_steps(int(self.side_px))  # of a window's columns, and of its rows
        self.width = self.steps_px.size
        y, x = (grid.ravel() for grid in np.meshgrid(self.steps_px, self.steps_px, indexing="ij"))
        self.offset_px = np.stack([x, y], axis=-1)  # window positions about the centre, lattice frame, (N, xy)
        position_px = self.center_px[:, None] + self.offset_px @ self.turn
        self._edge_px = np.array(reference.shape[::-1]) - 1.0  # the last pixel of the frame, (xy,)
        corners_px = position_px[:, [0, self.width - 1, -self.width, -1]]
        is_cut = np.asarray(~self._is_on_frame(corners_px).all(axis=1))
        self.position_px = np.clip(position_px, 0, self._edge_px)  # of the windows on the camera, (L, N, xy)

        self.bad = np.zeros(reference.shape, np.bool_) if bad is None else bad  # (row, column)
        self.image = repaired(reference, self.bad)  # the whole frame, (row, column)
        self.spline_coefficients = spline_coefficients(self.image)
        self.light, gradient = interpolate(self.spline_coefficients, self.position_px)  # (L, N)
        self.gradient = gradient @ self.turn.T  # per pixel, lattice frame, (L, N, xy)
        self.contrast = self.light.std(axis=1)  # (L,)
        self.usable = self._usable(is_cut)  # (L, N)
        spoilt = self._are_spoilt(is_cut)
        if np.mean(off_camera := is_cut & spoilt) > _OFF_CAMERA_FRACTION:
            raise ReconstructionError(
                f"{np.count_nonzero(off_camera)} of {off_camera.size} lenslets lie outside the frame of"
                f" {' x '.join(map(str, reference.shape))} pixels: check [lattice] and the frame's size, or omit"
                " sensor.lenslet_rows and lenslet_columns, which are then found"
            )
        in_pupil = sensor.is_in_pupil.ravel() & ~off_camera
        dark = ~(self._shown > DARK_CONTRAST * typical(self._shown[~off_camera])) | ~in_pupil
        is_excluded = np.zeros(self.lenslets, np.bool_)
        is_excluded[tuple(np.array([*excluded], np.intp).reshape(-1, 2).T)] = True
        self.excluded = is_excluded.ravel()
        self.absent = dark & ~self.excluded  # outside the pupil, or without an image in the reference
        self.lit = ~dark & ~spoilt & ~self.excluded
        self.at_edge = np.flatnonzero(is_cut & self.lit)  # lenslets at the frame's edge, which cuts their cells
        if self.excluded.all() or not in_pupil.any():
            by_hand = "all lenslets are excluded by hand: use some of them again"
            raise UnusableSettings(by_hand if in_pupil.any() else "no centre of a lenslet lies in [pupil]: change it")
        if not self.lit.any() or np.median(self._shown[self.lit] / self.contrast[self.lit]) ** 2 < _SMOOTH:
            raise ReconstructionError("the reference shows no light on its lenslets: was the light on?")

    def _is_on_frame(self, position_px: Floats, rim_px: float = -0.5) -> Booleans:
        """True for camera positions (..., xy) that lie on the frame, inside a rim of that width, (...)."""
        return np.asarray(np.all((position_px >= rim_px) & (position_px <= self._edge_px - rim_px), axis=-1))

    def _are_spoilt(self, is_cut: Booleans) -> Booleans:
        """True for lenslets (L,) of whose image too much lies on bad pixels, or beyond the frame that cuts them."""
        steepness = np.sum(self.gradient**2, axis=2)
        brightest = np.max(self.contrast[~is_cut], initial=0.0)
        whole = self.gradient[~is_cut & (self.contrast > DARK_CONTRAST * brightest)]
        mean = whole.mean(axis=0) if len(whole) else np.zeros_like(self.gradient[0])  # noise averages out
        self._typical_steepness = np.sum(mean**2, axis=1)  # squared gradients of the mean image, (N,)
        spoilt = np.asarray(np.sum(steepness * ~self.usable, axis=1) > _SPOILT * np.sum(steepness, axis=1))
        cut = np.flatnonzero(is_cut)
        spoilt[cut] = self._left_on_frame(cut, np.zeros((len(cut), 2))) < ON_FRAME
        return spoilt

    def _left_on_frame(self, lenslets: NDArray[np.intp], displacement: NDArray[np.floating[Any]]) -> Floats:
        """Share (K,) of a typical image on the frame, in some lenslets and displaced by (K, xy), px."""
        middle_px = self.center_px[lenslets] + displacement @ self.turn
        inside = self._is_on_frame(middle_px[:, None] + self.offset_px @ self.turn, _RIM_PX)
        whole = max(float(self._typical_steepness.sum()), np.finfo(np.float32).tiny)
        return np.asarray(inside @ self._typical_steepness / whole)

    def leaves_frame(self, displacement: NDArray[np.floating[Any]]) -> Booleans:
        """True for lenslets (L,) at the frame's edge whose image a displacement (L, xy), px, takes beyond it."""
        found = np.zeros(len(self.center_px), np.bool_)
        found[self.at_edge] = self._left_on_frame(self.at_edge, displacement[self.at_edge]) < 1 - _SPOILT
        return found

    def spline(self, light: Image, *, saturated: Booleans | None = None) -> Image:
        """Spline coefficients of a frame (row, column), bad and saturated pixels repaired."""
        bad = self.bad if saturated is None or not saturated.any() else self.bad | saturated
        return spline_coefficients(repaired(light, bad) if bad.any() else light)

    def cut(self, light: Image) -> Floats:
        """Cut another frame (row, column) into the same windows: (L, width, width)."""
        values, _ = interpolate(self.spline(light), self.position_px)
        return values.reshape(-1, self.width, self.width)

    def touched(self, pixels: Booleans) -> Booleans:
        """True for lenslets with one of the pixels (row, column) in their window, (L,)."""
        if not pixels.any():
            return np.zeros(len(self.center_px), np.bool_)
        return np.asarray(pixels[self._nearest].any(axis=1))

    @cached_property
    def _shown(self) -> Floats:
        """Structure of the subimages, counts, (L,)."""
        return structure(self.image[self._nearest].reshape(-1, self.width, self.width))

    @cached_property
    def _nearest(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of the pixels next to the windows' positions, (L, N)."""
        column, row = np.moveaxis(np.floor(self.position_px + 0.5).astype(np.intp), -1, 0)  # rint would repeat some
        return row, column

    def near(self, pixels: Booleans) -> Booleans:
        """True for lenslets with one of the pixels (row, column) in or next to their cell, (L,)."""
        if not pixels.any():
            return np.zeros(len(self.center_px), np.bool_)
        row, column = np.nonzero(pixels)
        away_px = (np.stack([column, row], axis=-1) - self.center_px[:, None]) @ self.turn.T
        near_px = self.cell_px / 2 + _NEXT_PX
        return np.asarray(np.any(np.all(np.abs(away_px) < near_px, axis=-1), axis=1))

    def range_used(self, displacement: NDArray[np.floating[Any]], modes: FieldModes) -> Floats:
        """Share (L,) of the allowed range that the displacement (L, xy, Q), px, uses at the field's edge."""
        if modes not in self._at_outline:
            self._at_outline[modes] = modes.values(*self._field_outline.T)
        moved_px = displacement.reshape(-1, modes.count) @ self._at_outline[modes]  # one product is faster than L
        edge_px = moved_px.reshape(len(displacement), 2, -1) + self.half_width_px * self._field_outline.T
        farthest_px = np.abs(edge_px).max(axis=(1, 2))
        allowed_px = max(self.reach_px - self.half_width_px, np.finfo(np.float32).tiny)
        return np.asarray(np.maximum(farthest_px - self.half_width_px, 0) / allowed_px)

    @cached_property
    def unusable(self) -> Booleans:
        """Bad pixels (row, column), and the frame's rim if it cuts lenslets."""
        if not self.at_edge.size:
            return self.bad
        rim = np.ones_like(self.bad)
        rim[_RIM_PX:-_RIM_PX, _RIM_PX:-_RIM_PX] = False
        return np.asarray(self.bad | rim)

    def _usable(self, is_cut: Booleans) -> Booleans:
        """True for window positions (L, N) without bad pixels around; of cut lenslets (L,), also inside the rim."""
        usable = np.ones(self.position_px.shape[:2], np.bool_)
        usable[is_cut] = self._is_on_frame(self.position_px[is_cut], _RIM_PX)
        if self.bad.any():
            rows, columns = self.bad.shape
            column, row = np.moveaxis(np.floor(self.position_px).astype(np.intp), -1, 0)
            for below, beside in np.ndindex(2, 2):
                usable &= ~self.bad[np.minimum(row + below, rows - 1), np.minimum(column + beside, columns - 1)]
        return usable


def structure(light: NDArray[np.floating[Any]]) -> Floats:
    """RMS of the light (L, n, n) that pixels of a row share with their neighbours, beyond a plane and chance: (L,).

    Noise, which they do not share, and a sloping background count nothing.
    """
    steps = centered_steps(light.shape[-1])
    away = light - light.mean(axis=(1, 2), keepdims=True)
    for along in (steps, steps[:, None]):
        away = away - along * (np.sum(along * away, axis=(1, 2), keepdims=True) / np.sum(along**2) / len(steps))
    shared = np.mean(away[:, :, 1:] * away[:, :, :-1], axis=(1, 2))
    by_chance = _BY_CHANCE * np.mean(away**2, axis=(1, 2)) / len(steps)
    return np.asarray(np.sqrt(np.maximum(shared - by_chance, 0.0)), np.float64)


def typical(contrast: Floats) -> float:
    """Median contrast of the lit lenslets, which may be few."""
    bright = np.sort(contrast)[-min(_BRIGHT, contrast.size)]
    return float(np.median(contrast[contrast >= DARK_CONTRAST * bright]))


def classify_lenslets(
    reference: ReferenceSubimages,
    modes: FieldModes,
    coefficients: Floats,
    *,
    covariance: Floats | CovarianceSource,
    residual_rms: Floats,
    contrast: NDArray[np.floating[Any]],
    faults: dict[LensletStatus, Booleans],
    range_used: Floats | None = None,
) -> Displacement:
    """Classify L lenslets and arrange the results on the lattice, NaN where lost.

    coefficients c_q, px, (L, xy, Q); covariance (L, Q, xy, Q, xy), px^2; residual_rms (L,) over the contrast of the
    reference's best subimage; contrast (L,) of the frame's subimages. `faults` are the losses (L,) found by the method;
    of several the last counts, and darkness above all. `range_used` (L,) as in `Displacement`, if it is not that of a
    field which keeps to its cell.
    """
    lost = np.zeros(len(coefficients), np.bool_)
    for fault in faults.values():
        lost |= fault
    if range_used is None:
        range_used = reference.range_used(np.where(lost[:, None, None], 0, coefficients), modes)
    outcome = np.full(len(coefficients), LensletStatus.CONVERGED, np.int8)
    outcome[range_used > 1] = LensletStatus.LEFT_CELL
    if reference.at_edge.size:
        outcome[reference.leaves_frame(np.where(lost[:, None], 0, coefficients[:, :, 0]))] = LensletStatus.LEFT_CELL
    for reason, fault in faults.items():
        outcome[fault] = reason
    contrast = np.where(np.isfinite(contrast), contrast, 0.0)
    outcome[~reference.lit | ~(contrast > DARK_CONTRAST * median(contrast[reference.lit]))] = LensletStatus.DARK
    outcome[reference.absent] = LensletStatus.ABSENT
    outcome[reference.excluded] = LensletStatus.EXCLUDED
    found = outcome == LensletStatus.CONVERGED
    far = (outcome == LensletStatus.LEFT_CELL) & (range_used > 0)
    all_found = bool(found.all())

    def arrange(values: Floats, keep: Booleans = found) -> Floats:
        kept = values
        if not all_found:
            kept = np.full_like(values, np.nan)
            kept[keep] = values[keep]
        return kept.reshape(*reference.lenslets, *values.shape[1:])

    return Displacement(
        modes=modes,
        coefficients=arrange(np.swapaxes(coefficients, 1, 2)),
        covariance_source=arrange(covariance) if isinstance(covariance, np.ndarray) else covariance.kept(found),
        outcome=outcome.reshape(reference.lenslets),
        residual_rms=arrange(residual_rms),
        chi_square=np.full(reference.lenslets, np.nan),
        range_used=arrange(range_used, found | far),
    )
