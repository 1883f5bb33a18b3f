"""From a camera frame to the wavefront: what bench and reference determine is prepared once, then frames pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, Lattice, Sensor, require
from reconstruction.modal import ModalSolver
from reconstruction.pupil_modes import PupilBasis, pupil_modes
from reconstruction.registration import RegistrationSettings, prepare_registration
from reconstruction.spline import Image
from reconstruction.subimages import ReferenceSubimages
from reconstruction.wavefront import Solution, Wavefront
from reconstruction.zonal import ZonalSolution

Counts = NDArray[np.integer[Any]] | NDArray[np.floating[Any]]

_SATURATED_FRACTION = 0.01  # of the frame's pixels; above it the frame as a whole is refused
_BACKGROUND_PERCENT = 1.0  # where no dark was given, the darkest pixels that stand for the background


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructionSettings:
    """How displacements become wavefronts."""

    method: Literal["zonal", "modal"] = "modal"
    basis: PupilBasis = "legendre"
    pupil_modes: int = 66

    def __post_init__(self) -> None:
        require({"pupil_modes must be 3 ... 1000": 3 <= self.pupil_modes <= 1000})


class Reconstructor:
    """Turns frames into wavefronts. It never changes: another reference or setting makes another one."""

    def __init__(
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
    ) -> None:
        """Prepare for a reference and a dark (row, column) in counts; `full_scale` is the count of saturation.

        Without a dark, the darkest percent of each image's pixels is taken for the background.
        """
        self._shape = reference.shape
        self._dark = None if dark is None else _checked(dark, "dark", reference.shape)
        self._full_scale = full_scale
        self._sensor, self._field = sensor, field
        light = self._light(reference, "reference")
        subimages = ReferenceSubimages(light, sensor=sensor, lattice=lattice, field=field)
        self._register = prepare_registration(subimages, registration, field)
        self._modal = None
        if reconstruction.method == "modal":
            self._modal = ModalSolver(pupil_modes(sensor, reconstruction.basis, reconstruction.pupil_modes))

    def __call__(self, frame: Counts) -> Wavefront:
        """Measure the wavefront that a frame (row, column), counts, shows against the reference."""
        light = self._light(frame, "frame")
        saturated = frame >= self._full_scale
        displacement = self._register(light, saturated=saturated)
        valid = displacement.valid
        if np.count_nonzero(valid) < 2:
            raise ReconstructionError(
                "no lenslet of the frame could be matched with the reference: is the light on?", image="frame"
            )
        slopes = displacement.coefficients * self._sensor.slope_per_px
        solution: Solution
        if self._modal is None:
            solution = ZonalSolution(slopes, valid, self._sensor.lenslet_pitch_m)
        else:
            solution = self._modal(slopes, displacement.variance * self._sensor.slope_per_px**2, valid)
        return Wavefront.of(self._field, displacement, solution)

    def _light(self, image: Counts, what: str) -> Image:
        """Check an image and return it as float32 (row, column) counts above the dark or the background."""
        light = _checked(image, what, self._shape)
        if np.count_nonzero(image >= self._full_scale) > _SATURATED_FRACTION * image.size:
            raise ReconstructionError(
                f"the {what} is saturated: shorten the exposure or lower the light's current", image=what
            )
        background = self._dark if self._dark is not None else np.percentile(light, _BACKGROUND_PERCENT)
        return np.asarray(light - background, np.float32)


def _checked(image: Counts, what: str, shape: tuple[int, ...]) -> Image:
    """Return an image as float32 if it is a finite one of the right shape, else say what it is."""
    if image.ndim != 2 or image.shape != shape:
        raise ReconstructionError(
            f"the {what} has {_size(image.shape)} pixels, but the reference has {_size(shape)}", image=what
        )
    if not (np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)):
        raise ReconstructionError(f"the {what} holds {image.dtype} values: grey counts are needed", image=what)
    with np.errstate(over="ignore"):  # too large a number becomes infinite, and is refused as that
        light = image.astype(np.float32)
    if not np.isfinite(light).all():
        raise ReconstructionError(f"the {what} holds values that are not finite", image=what)
    return light


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape)
