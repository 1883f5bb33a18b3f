"""Settings of registration and reconstruction: `[registration]` and `[reconstruction]` of a bench."""

import math
from dataclasses import dataclass
from typing import Literal

from reconstruction.geometry import require

PupilBasis = Literal["legendre", "zernike"]
SampleModel = Literal["automatic", "free", "layers"]
Warp = Literal["translation", "affine", "quadratic", "cubic", "quartic"]
Method = Literal["gauss_newton", "correlation", "correlation_fft", "centroids", "itk_affine"]
PUPIL_MODES = range(3, 1001)  # allowed numbers
FIELD_MODES: dict[Warp, int] = {"translation": 1, "affine": 3, "quadratic": 6, "cubic": 10, "quartic": 15}


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationSettings:
    """Method and warp of the registration, and the star positions of a pinhole source."""

    method: Method = "gauss_newton"
    warp: Warp | None = None  # omitted: the one with the least expected error; quartic if the noise is unknown
    rotation: bool = False  # gauss_newton: whether subimages may rotate; layers cannot make them
    threads: int = 2  # of gauss_newton
    excluded: tuple[tuple[int, int], ...] = ()  # lenslets (row, column from 0) that are left out, as if lost
    star_rows: int = 3
    star_columns: int = 3
    star_spacing_m: float = 0.5e-3

    def __post_init__(self) -> None:
        require(
            {
                "threads must be 1 ... 64": 1 <= self.threads <= 64,
                "star_rows must be 1 ... 99": 1 <= self.star_rows <= 99,
                "star_columns must be 1 ... 99": 1 <= self.star_columns <= 99,
                "star_spacing_m must be positive": 0 < self.star_spacing_m < math.inf,
            }
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructionSettings:
    """From displacements to wavefronts; without a number of modes as many as the lattice carries, smoothed."""

    method: Literal["zonal", "modal"] = "modal"
    basis: PupilBasis = "legendre"
    pupil_modes: int | None = None
    response: bool = True  # modal: with warps that do not rotate, the modelled response instead of mean gradients
    sample: SampleModel = "automatic"  # modal: any wavefront, one or two layers, or the one that the evidence prefers
    refine: bool = False  # live: correct frames by the bias that a forward model finds in the background

    def __post_init__(self) -> None:
        limits = f"{PUPIL_MODES.start} ... {PUPIL_MODES[-1]}"
        require({f"pupil_modes must be {limits}": self.pupil_modes is None or self.pupil_modes in PUPIL_MODES})


def obstacle_to_layers(reconstruction: ReconstructionSettings, registration: RegistrationSettings) -> str:
    """Return the setting with which layers cannot be assumed; empty if they can."""
    obstacles = {
        'reconstruction.method = "zonal"': reconstruction.method == "zonal",
        f'reconstruction.basis = "{reconstruction.basis}"': reconstruction.basis != "legendre",
        f"reconstruction.pupil_modes = {reconstruction.pupil_modes}": reconstruction.pupil_modes is not None,
        f'registration.method = "{registration.method}"': registration.method != "gauss_newton",
        'registration.warp = "translation"': registration.warp == "translation",
    }
    return next((setting for setting, is_set in obstacles.items() if is_set), "")
