"""From a camera frame to the wavefront: everything independent of the frame is prepared once."""

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
from reconstruction.solve.modal import ModalSolver
from reconstruction.solve.weights import lenslet_weights, mean_variance, whitening
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Solution, Wavefront

_SATURATED_FRACTION = 0.01  # of the frame's pixels; with more, the frame is rejected
_BACKGROUND_PERCENT = 1.0  # without a dark, this percentile of the counts is the background
_WARP_CHOICE_MODES = 45  # pupil modes for the predicted noise; a smooth wavefront needs about as many
# Root of the difference of the squared residuals of affine and quadratic, on the screens of docs/estimator.md
# (4.2 rad RMS).
_QUADRATIC_GAIN_RAD = 0.15


class Reconstructor:
    """Turns frames into wavefronts. Immutable: another reference or setting needs another one.

    Parameters
    ----------
    reference : (row, column)
        Counts of the frame without the sample.
    sensor, lattice, field, registration, reconstruction
        Geometry and settings of the bench. Without `registration.warp`, the noise decides between affine and
        quadratic; quadratic if the noise is unknown.
    dark : (row, column), optional
        Counts without light. Without it, the darkest percent of each image's pixels is the background.
    full_scale : float
        Count at which a pixel is saturated.
    noise : CameraNoise, optional
        Noise of a single frame. It weights pixels and lenslets and gives absolute error bars.
    reference_frames : float
        Number of frames averaged in the reference.

    Raises
    ------
    ReconstructionError
        If the images do not match or are saturated, or the lenslets cannot distinguish the pupil modes.
    """

    def __init__(  # noqa: PLR0913 - all of a measurement but the frame; all but the settings have defaults
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
        # The reference registered against itself shows the certainty of each lenslet and field mode.
        at_rest = self._prepare(light, registration)
        self.whitening = whitening(at_rest.covariance)
        self._expected = _mean_variance(at_rest)  # (L,), px^2; NaN where unknown
        self._usual = np.nanmedian(self._expected) if np.isfinite(self._expected).any() else 1.0
        self._modal = None
        if reconstruction.method == "modal":
            count = reconstruction.pupil_modes
            modes = pupil_modes(sensor, reconstruction.basis, count)
            self._modal = ModalSolver(modes, self.whitening, is_smooth=count is None)
        if at_rest.valid.any():
            self.solve(at_rest)  # fails early if the modes cannot be distinguished, and warms the caches

    def __call__(self, frame: Counts, *, bias: Floats | None = None) -> Wavefront:
        """Measure the wavefront of a frame: `register`, then `solve`."""
        return self.solve(self.register(frame), bias=bias)

    def register(self, frame: Counts, *, start: Displacement | None = None) -> Displacement:
        """Measure the displacement of each subimage from the reference.

        Parameters
        ----------
        frame : (row, column)
            Counts.
        start : Displacement, optional
            Of an earlier frame. It saves time and changes the result by far less than its error.

        Raises
        ------
        ReconstructionError
            If fewer than two lenslets match the reference, or the frame has the wrong size or is saturated.
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
        """Reconstruct the wavefront from displacements.

        `bias` (lenslet_row, lenslet_column, field_mode, xy), px, a known systematic error, is subtracted first.
        """
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

    def registration_for(self, reference: Image) -> RegistrationMethod:
        """Prepare the same registration for another reference (row, column), counts above the dark."""
        return prepare_registration(self._cut(reference), self.registration, self.field)

    def weights_of(self, displacement: Displacement) -> Floats:
        """Weight of each lenslet, (lenslet_row, lenslet_column); all 1 if the noise is unknown."""
        if self.noise is None:
            return np.ones(displacement.valid.shape)
        weights = lenslet_weights(_mean_variance(displacement), self._expected, float(self._usual))
        return weights.reshape(displacement.valid.shape)

    def _prepare(self, light: Image, registration: RegistrationSettings) -> Displacement:
        """Prepare the registration, choose the warp if none is set, and register the reference."""

        @cache
        def prepare(warp: Warp) -> tuple[RegistrationMethod, Displacement]:
            method = prepare_registration(self.subimages, replace(registration, warp=warp), self.field)
            return method, method(light, saturated=np.zeros(light.shape, np.bool_))

        warp = registration.warp or "quadratic"
        if registration.warp is None and self.noise is not None and registration.method == "gauss_newton":
            # Quadratic modes remove most of the systematic error and add noise. The cubic warp is never chosen: it
            # helps only with refinement, and only if no light strays into the neighbours' cells.
            added_rad2 = self._noise_rad2(prepare("quadratic")[1]) - self._noise_rad2(prepare("affine")[1])
            warp = "quadratic" if added_rad2 < _QUADRATIC_GAIN_RAD**2 else "affine"
        self.registration = replace(registration, warp=warp)
        self._register, at_rest = prepare(warp)
        return at_rest

    def _noise_rad2(self, displacement: Displacement) -> float:
        """Mean noise variance of the views, rad^2, if every lenslet were as certain as the mean valid one."""
        valid = displacement.valid
        if not valid.any():
            return np.inf
        everywhere = np.ones(valid.shape, np.bool_)  # a few lit lenslets could not carry the modes
        mean = np.mean(displacement.covariance[valid], axis=0) * self.sensor.slope_per_px**2
        covariance = np.broadcast_to(mean, displacement.covariance.shape)
        lattice_count = pupil_modes(self.sensor, "legendre", None).values.shape[0]
        modes = pupil_modes(self.sensor, "legendre", min(_WARP_CHOICE_MODES, lattice_count))
        solver = ModalSolver(modes, whitening(displacement.covariance), is_smooth=False)
        slopes = np.zeros_like(displacement.coefficients)
        wavefront = Wavefront.of(self.sensor, self.field, displacement, solver(slopes, covariance, everywhere))
        return float(np.nanmean(wavefront.sigma() ** 2))

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

    def _light(self, image: Counts, name: str) -> tuple[Image, Mask]:
        """Check an image; return its counts above the dark or the background, and its saturated pixels."""
        light, saturated = self._above_dark(image, name), self._saturated(image)
        if np.count_nonzero(saturated) > _SATURATED_FRACTION * image.size:
            raise ReconstructionError(
                f"the {name} is saturated: shorten the exposure or lower the light's current", image=name
            )
        return light, saturated

    def _above_dark(self, image: Counts, name: str) -> Image:
        _check(image, name, self.frame_shape)
        if self._dark is not None and np.issubdtype(image.dtype, np.integer):
            return np.subtract(image, self._dark, dtype=np.float32)
        light = _finite(image, name)
        light -= self._dark if self._dark is not None else np.float32(np.percentile(light, _BACKGROUND_PERCENT))
        return light

    def _saturated(self, image: Counts) -> Mask:
        if not math.isfinite(self._full_scale):
            return np.zeros(image.shape, np.bool_)
        if np.issubdtype(image.dtype, np.integer):
            return np.asarray(image >= math.ceil(self._full_scale))  # 7x faster than comparing with a float
        return np.asarray(image >= self._full_scale)


def _mean_variance(displacement: Displacement) -> Floats:
    covariance = displacement.covariance
    return mean_variance(covariance.reshape(-1, *covariance.shape[2:]))


def _check(image: Counts, name: str, shape: tuple[int, ...]) -> None:
    """Raise if an image has the wrong shape or does not hold numbers."""
    if image.ndim != 2 or image.shape != shape:
        raise ReconstructionError(
            f"the {name} has {_size(image.shape)} pixels, but the reference has {_size(shape)}", image=name
        )
    if not (np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)):
        raise ReconstructionError(f"the {name} holds {image.dtype} values: grey counts are needed", image=name)


def _finite(image: Counts, name: str) -> Image:
    """Copy an image to float32; raise if a value is not finite."""
    with np.errstate(over="ignore"):  # overflow becomes infinite, which is rejected below
        light = image.astype(np.float32)
    if not np.issubdtype(image.dtype, np.integer) and not np.isfinite(light).all():
        raise ReconstructionError(f"the {name} holds values that are not finite", image=name)
    return light


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape)
