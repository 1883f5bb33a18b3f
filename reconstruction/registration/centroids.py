"""Registration by the centroids of stars: the paper's reference method, for a pinhole mask.

A star's displacement is the difference of its centroids in frame and reference. A small window on the subpixel grid
follows each star: the background (median of its border) and a fraction of the star's height are subtracted, negative
values are cut off, and the window moves to the centre of gravity until it stays.
"""

from typing import NamedTuple

import numpy as np

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Displacement, LensletStatus, RegistrationMethod, diagonal_covariance
from reconstruction.errors import ReconstructionError
from reconstruction.frame.spline import interpolate
from reconstruction.geometry import Field, centered_steps, require
from reconstruction.modes.field_modes import SampledModes
from reconstruction.registration.correlation import correlation_spectrum, cross_correlation, normalised
from reconstruction.registration.subimages import MISFIT, LensletModel, ReferenceSubimages, classify_lenslets
from reconstruction.settings import RegistrationSettings

_THRESHOLD = 0.1  # of the star's height above the background
_WINDOW_BLURS = 1.5  # largest half width of a window over the first zero of a star's image
_ITERATIONS = 12
_TOLERANCE_PX = 2e-3
_CONVERGED_PX = 0.05  # largest last step of a converged window
_FAINT = 0.2  # of the median star's height; fainter stars are lost
_STARLESS_FRACTION = 0.5  # of the lit lenslets; if more lack a star, the reference shows another source


def prepare(
    reference: ReferenceSubimages, settings: RegistrationSettings, field: Field, _model: LensletModel | None
) -> RegistrationMethod:
    """Prepare the method `centroids` for the stars of the settings."""
    spacing = settings.star_spacing_m / field.half_width_m
    columns, rows = centered_steps(settings.star_columns), centered_steps(settings.star_rows)
    try:
        return Centroids(reference, star_x=columns * spacing, star_y=rows * spacing)
    except ValueError as error:
        raise ReconstructionError(f"registration.star_spacing_m does not suit the lenslets: {error}") from error


class _Stars(NamedTuple):
    """L lenslets x S stars in windows of N pixels."""

    position_px: Floats  # centroids about the lenslet's centre, lattice frame, (L, S, xy)
    window: Floats  # light in the window about the centroid, less the background, (L, S, N)
    height: Floats  # of the star above the background, (L, S)
    step_px: Floats  # the last step, (L, S)


class Centroids:
    """Registration by stars, whose positions in the reference are found when prepared."""

    def __init__(self, reference: ReferenceSubimages, *, star_x: Floats, star_y: Floats) -> None:
        """Prepare for stars at all star_x (column,) and star_y (row,), normalised and ascending.

        Raise `ReconstructionError` if the reference shows no stars.
        """
        for name, position in (("star_x", star_x), ("star_y", star_y)):
            require({f"{name} must lie in the field, -1 ... 1": bool(np.all(np.abs(position) <= 1))})
        blur_px = reference.blur_px
        gaps = np.concatenate([np.diff(star_x), np.diff(star_y)]) * reference.half_width_px
        self._half_px = min(gaps.min(initial=np.inf) / 2, _WINDOW_BLURS * blur_px)  # of the window
        require(
            {"stars must lie at least two pixels' and a lenslet's blur apart": self._half_px >= max(blur_px / 2, 1)}
        )
        self._reference, self._modes = reference, SampledModes(star_x, star_y)
        self._offset_px, self._border = _window(self._half_px)
        light = reference.light.reshape(-1, reference.width, reference.width)
        self._spectrum = correlation_spectrum(normalised(light))
        # Whole-subimage shifts are searched that leave the outermost star inside the cell.
        outermost_px = np.abs(np.concatenate([star_x, star_y])).max() * reference.half_width_px
        self._search = max(int(reference.reach_px - outermost_px), 0)
        nominal_px = np.stack(self._modes.nodes, axis=-1) * reference.half_width_px
        start_px = np.broadcast_to(nominal_px, (len(light), *nominal_px.shape))
        self._stars = self._follow(reference.spline_coefficients, start_px)
        self._known = self._are_stars(self._stars, start_px)
        if not np.mean(self._known[reference.lit].all(axis=1)) > 1 - _STARLESS_FRACTION:
            raise ReconstructionError("the reference shows no stars where they are expected: is the pinhole mask in?")
        self._contrast = self._stars.window.std(axis=-1)  # (L, S)

    def __call__(self, light: Image, *, saturated: Booleans, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        """Register a frame; see `displacement.RegistrationMethod`. A lenslet is lost with any of its stars."""
        reference, before = self._reference, self._stars
        window = reference.cut(light)
        correlation = cross_correlation(self._spectrum, normalised(window), self._search)
        shifts = correlation.shape[1]
        best = np.divmod(correlation.reshape(len(window), -1).argmax(axis=1), shifts)
        start_px = before.position_px + (np.stack(best[::-1], axis=-1) - self._search)[:, None, :]
        after = self._follow(reference.spline(light), start_px)

        # The frame's window should be that of the reference, scaled in brightness.
        gain = np.einsum("lsn,lsn->ls", after.window, before.window)
        gain /= np.maximum(np.einsum("lsn,lsn->ls", before.window, before.window), 1e-30)
        difference = after.window - gain[..., None] * before.window
        misfit = difference.std(axis=-1) / np.maximum(gain * self._contrast, 1e-30)  # (L, S)
        lost = ~(self._are_stars(after, start_px) & self._known & (misfit < MISFIT))

        displacement = np.swapaxes(after.position_px - before.position_px, 1, 2)  # (L, xy, S)
        variance = np.repeat(self._variance(after, difference)[..., None], 2, axis=-1)  # (L, S, xy)
        return classify_lenslets(
            reference,
            self._modes,
            displacement,
            covariance=diagonal_covariance(variance),
            residual_rms=np.sqrt(np.mean(misfit**2, axis=1)) * reference.contrast / reference.contrast.max(),
            contrast=after.height.min(axis=1),
            faults={LensletStatus.DIVERGED: lost.any(axis=1), LensletStatus.SATURATED: reference.touched(saturated)},
        )

    def _follow(self, coefficients: Image, start_px: Floats) -> _Stars:
        """Find the stars near start_px (L, S, xy) in a frame given by its spline coefficients."""
        # The window starts at the brightest place nearby.
        coarse_px, _ = _window(self._half_px - 1)
        light = self._light(coefficients, start_px, coarse_px)
        smooth = light @ _smoothing(coarse_px, self._reference.blur_px)
        position_px = start_px + coarse_px[smooth.argmax(axis=-1)]
        for _ in range(_ITERATIONS):
            stars = self._weigh(coefficients, position_px)
            position_px = stars.position_px
            if not np.any(stars.step_px > _TOLERANCE_PX):
                break
        return stars

    def _weigh(self, coefficients: Image, position_px: Floats) -> _Stars:
        """Move the windows at position_px (L, S, xy) to the centres of gravity, once."""
        window = self._light(coefficients, position_px, self._offset_px)
        window -= np.median(window[..., self._border], axis=-1, keepdims=True)
        height = window.max(axis=-1)
        weight = np.maximum(window - _THRESHOLD * height[..., None], 0)
        step = (weight @ self._offset_px) / np.maximum(weight.sum(axis=-1, keepdims=True), 1e-30)
        return _Stars(position_px + step, window, height, np.hypot(step[..., 0], step[..., 1]))

    def _light(self, coefficients: Image, position_px: Floats, offset_px: Floats) -> Floats:
        """Light at offsets (N, xy) about positions (L, S, xy), both in the lattice frame: (L, S, N)."""
        turn = self._reference.turn
        camera_px = (self._reference.center_px[:, None] + position_px @ turn)[:, :, None] + offset_px @ turn
        return interpolate(coefficients, camera_px)[0]

    def _are_stars(self, stars: _Stars, start_px: Floats) -> Booleans:
        """True for stars that are bright, near start_px (L, S, xy), inside the cell and converged: (L, S)."""
        strayed = np.abs(stars.position_px - start_px).max(axis=-1) > self._half_px
        left = np.abs(stars.position_px).max(axis=-1) > self._reference.reach_px
        faint = ~(stars.height > _FAINT * np.median(stars.height[self._reference.lit]))
        return np.asarray(~(strayed | left | faint) & (stars.step_px < _CONVERGED_PX))

    def _variance(self, stars: _Stars, difference: Floats) -> Floats:
        """Variance of displacements along one axis, px^2, (L, S), by the `difference` (L, S, N) on the border."""
        noise = np.mean(difference[..., self._border] ** 2, axis=-1)
        weight = np.maximum(stars.window - _THRESHOLD * stars.height[..., None], 0)
        arm = (weight > 0) @ (self._offset_px**2).mean(axis=1)
        return np.asarray(noise * arm / np.maximum(weight.sum(axis=-1), 1e-30) ** 2)


def _window(half_px: float) -> tuple[Floats, Booleans]:
    """Positions of a square window, whole pixels apart (N, xy), and its border (N,)."""
    steps = np.arange(-int(half_px), int(half_px) + 1, dtype=np.float64)
    y, x = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    return np.stack([x, y], axis=-1), np.maximum(np.abs(x), np.abs(y)) == steps[-1]


def _smoothing(position_px: Floats, blur_px: float) -> Floats:
    """Matrix (N, N) of a Gaussian average, as wide as a star, at positions (N, xy)."""
    square_px = np.sum((position_px[:, None] - position_px) ** 2, axis=-1)
    kernel = np.exp(-square_px / (2 * (0.4 * blur_px) ** 2))
    return np.asarray(kernel / kernel.sum(axis=0))
