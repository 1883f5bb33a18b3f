"""From a camera frame to the wavefront: what bench and reference determine is prepared once, then frames pass."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from reconstruction.arrays import Counts, Floats, Image, Mask
from reconstruction.displacement import Displacement, Outcome, RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.frame.bad_pixels import find_bad_pixels
from reconstruction.frame.noise import CameraNoise
from reconstruction.geometry import Field, Lattice, Sensor
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.registration.methods import prepare_registration
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, Warp
from reconstruction.solve.automatic_warp import automatic_warp
from reconstruction.solve.lenslet_weights import lenslet_weights, mean_variance
from reconstruction.solve.modal import ModalSolver
from reconstruction.solve.whitening import whitening
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Solution, Wavefront

_SATURATED_FRACTION = 0.01  # of the frame's pixels; above it the frame as a whole is refused
_BACKGROUND_PERCENT = 1.0  # where no dark was given, the darkest pixels that stand for the background


class Reconstructor:
    """Turns frames into wavefronts. It never changes: another reference or setting makes another one."""

    def __init__(  # noqa: PLR0913 - the whole of a measurement but the frame; each beyond the settings has its default
        self,
        reference: Counts,
        *,
        sensor: Sensor,
        lattice: Lattice,
        field: Field,
        registration: RegistrationSettings,
        reconstruction: ReconstructionSettings,
        dark: Counts | None = None,
        full_scale: float = np.inf,
        noise: CameraNoise | None = None,
        reference_frames: float = np.inf,
    ) -> None:
        """Prepare for a reference and a dark (row, column) in counts; `full_scale` is the count of saturation.

        Without a dark, the darkest percent of each image's pixels is taken for the background. `noise` is that of a
        single frame, where it is known; the reference is the mean of `reference_frames` frames.
        """
        self.frame_shape = reference.shape[0], reference.shape[-1]
        self._dark = None
        if dark is not None:
            _check(dark, "dark", reference.shape)
            self._dark = _finite(dark, "dark")
        self._full_scale = full_scale
        self.sensor, self.lattice, self.field, self.noise = sensor, lattice, field, noise
        self._reference_frames = reference_frames
        light, _ = self._light(reference, "reference")
        self._bad = find_bad_pixels(reference, dark)
        self.subimages = self._cut(light)
        own = self._prepare(light, registration)
        # What the registration makes of the reference itself tells how certain each lenslet is, and of what.
        self.whitening = whitening(own.covariance)
        self._expected = _mean_variance(own)  # (L,), px^2; NaN where it is not known
        self._usual = np.nanmedian(self._expected) if np.isfinite(self._expected).any() else 1.0
        self._modal = None
        if reconstruction.method == "modal":
            count = reconstruction.pupil_modes
            modes = pupil_modes(sensor, reconstruction.basis, count)
            self._modal = ModalSolver(modes, self.whitening, is_smooth=count is None)
        if own.valid.any():
            self.solve(own)  # says at once if the lenslets cannot tell the modes apart, and spares it the first frame

    def __call__(self, frame: Counts, *, bias: Floats | None = None) -> Wavefront:
        """Measure the wavefront that a frame (row, column), counts, shows against the reference.

        `bias` (lenslet_row, lenslet_column, field_mode, xy), px, is what displacements are known to be too large by.
        """
        return self.solve(self.register(frame), bias=bias)

    def register(self, frame: Counts, *, start: Displacement | None = None) -> Displacement:
        """Find how the subimages of a frame (row, column), counts, lie with respect to the reference.

        `start` is where they lay in a frame before: near it the search is quicker, and its result the same.
        """
        light, saturated = self._light(frame, "frame")
        displacement = self._register(light, saturated=saturated, start=start)
        if np.count_nonzero(displacement.valid) < 2:
            left = np.count_nonzero(displacement.outcome == Outcome.LEFT_CELL)
            why = "is the light on?"
            if left > displacement.outcome.size / 4:
                why = f"{left} subimages have left their cells, the aberration is beyond the dynamic range"
            raise ReconstructionError(
                f"no lenslet of the frame could be matched with the reference: {why}", image="frame"
            )
        return displacement

    def solve(self, displacement: Displacement, *, bias: Floats | None = None) -> Wavefront:
        """Turn displacements, less their `bias`, into the wavefront."""
        if bias is not None:
            displacement = replace(displacement, coefficients=displacement.coefficients - bias)
        valid, per_px = displacement.valid, self.sensor.slope_per_px
        slopes, covariance = displacement.coefficients * per_px, displacement.covariance * per_px**2
        weights = self.weights_of(displacement)
        solution: Solution
        if self._modal is None:
            solution = ZonalSolution(slopes, valid, self.sensor.lenslet_pitch_m, weights, covariance)
        else:
            solution = self._modal(slopes, covariance, valid, weights=weights)
        return Wavefront.of(self.sensor, self.field, displacement, solution)

    def against(self, reference: Image) -> RegistrationMethod:
        """Prepare the same registration for another reference (row, column), counts above the dark."""
        return prepare_registration(self._cut(reference), self.registration, self.field)

    def _prepare(self, light: Image, registration: RegistrationSettings) -> Displacement:
        """Prepare the registration, with the warp that the noise allows if none is set; register the reference."""

        @cache
        def prepare(warp: Warp) -> tuple[RegistrationMethod, Displacement]:
            estimator = prepare_registration(self.subimages, replace(registration, warp=warp), self.field)
            return estimator, estimator(light, saturated=np.zeros(light.shape, np.bool_))

        warp = registration.warp or "quadratic"
        if registration.warp is None and self.noise is not None and registration.method == "gauss_newton":
            warp = automatic_warp(lambda each: prepare(each)[1], self.sensor, self.field)
        self.registration = replace(registration, warp=warp)
        self._register, own = prepare(warp)
        return own

    def weights_of(self, displacement: Displacement) -> Floats:
        """How much each lenslet counts, (lenslet_row, lenslet_column); see `lenslet_weights`."""
        if self.noise is None:
            return np.ones(displacement.valid.shape)
        weights = lenslet_weights(_mean_variance(displacement), self._expected, float(self._usual))
        return weights.reshape(displacement.valid.shape)

    def _cut(self, light: Image) -> ReferenceSubimages:
        return ReferenceSubimages(
            light,
            sensor=self.sensor,
            lattice=self.lattice,
            field=self.field,
            noise=self.noise,
            reference_frames=self._reference_frames,
            bad=self._bad,
        )

    def _light(self, image: Counts, what: str) -> tuple[Image, Mask]:
        """Check an image; return its counts above the dark or the background, and where it is saturated."""
        light, saturated = self._above_dark(image, what), self._saturated(image)
        if np.count_nonzero(saturated) > _SATURATED_FRACTION * image.size:
            raise ReconstructionError(
                f"the {what} is saturated: shorten the exposure or lower the light's current", image=what
            )
        return light, saturated

    def _above_dark(self, image: Counts, what: str) -> Image:
        """Check an image; return a float32 of its own."""
        _check(image, what, self.frame_shape)
        if self._dark is not None and np.issubdtype(image.dtype, np.integer):
            return np.subtract(image, self._dark, dtype=np.float32)
        light = _finite(image, what)
        light -= self._dark if self._dark is not None else np.float32(np.percentile(light, _BACKGROUND_PERCENT))
        return light

    def _saturated(self, image: Counts) -> Mask:
        """Which pixels of an image (row, column) are at full scale."""
        if not math.isfinite(self._full_scale):
            return np.zeros(image.shape, np.bool_)
        if np.issubdtype(image.dtype, np.integer):
            return np.asarray(image >= math.ceil(self._full_scale))  # seven times as quick as with a broken number
        return np.asarray(image >= self._full_scale)


def _mean_variance(displacement: Displacement) -> Floats:
    """Variance of every lenslet's displacement, px^2, (L,); see `lenslet_weights.mean_variance`."""
    covariance = displacement.covariance
    return mean_variance(covariance.reshape(-1, *covariance.shape[2:]))


def _check(image: Counts, what: str, shape: tuple[int, ...]) -> None:
    """Refuse what is no image of the right shape, and say what it is."""
    if image.ndim != 2 or image.shape != shape:
        raise ReconstructionError(
            f"the {what} has {_size(image.shape)} pixels, but the reference has {_size(shape)}", image=what
        )
    if not (np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)):
        raise ReconstructionError(f"the {what} holds {image.dtype} values: grey counts are needed", image=what)


def _finite(image: Counts, what: str) -> Image:
    """Return an image as a float32 of its own; refuse numbers that are not finite."""
    with np.errstate(over="ignore"):  # too large a number becomes infinite, and is refused as that
        light = image.astype(np.float32)
    if not np.issubdtype(image.dtype, np.integer) and not np.isfinite(light).all():
        raise ReconstructionError(f"the {what} holds values that are not finite", image=what)
    return light


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape)
