"""Settings of registration and reconstruction: `[registration]` and `[reconstruction]` of a bench."""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le
from typing_extensions import Doc

from reconstruction.annotated_settings import Checked
from reconstruction.geometry import STAR_SPACING_M, STARS
from reconstruction.runtime.threads import THREADS

PupilBasis = Literal["legendre", "zernike"]
SampleModel = Literal["automatic", "free", "layers"]
Warp = Literal["translation", "affine", "quadratic", "cubic", "quartic"]
Method = Literal["automatic", "gauss_newton", "centroids", "itk_affine"]
WARPING: tuple[Method, ...] = ("automatic", "gauss_newton")  # methods that may fit the warp of the settings
PUPIL_MODES = range(3, 1001)  # allowed numbers
FIELD_MODES: dict[Warp, int] = {"translation": 1, "affine": 3, "quadratic": 6, "cubic": 10, "quartic": 15}


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationSettings(Checked):
    """Method and warp of the registration, and the star positions of a pinhole source."""

    method: Annotated[
        Method,
        Doc(
            "Registration of subimages with the reference: Gauss-Newton for pictures, centroids for spots, automatic"
            " for the one that suits the reference; the paper's ITK is too slow for live use"
        ),
    ] = "automatic"
    warp: (
        Annotated[
            Warp,
            Doc(
                "Deformation of a subimage that Gauss-Newton may find; more freedom resolves finer changes over the"
                " field. Omitted: quartic if layers may be assumed, otherwise the one with the least expected error"
            ),
        ]
        | None
    ) = None
    rotation: Annotated[bool, Doc("Rotation is fitted, Gauss-Newton only; thin layers cause none")] = False
    threads: Annotated[int, Ge(1), Le(64), Doc("Number of threads, Gauss-Newton only")] = THREADS
    excluded: Annotated[tuple[tuple[int, int], ...], Doc("Lenslets (row, column from 0) that are left out")] = ()
    star_rows: Annotated[int, Ge(1), Le(99), Doc("Centroids: stars of the mask; only those in the field count")] = STARS
    star_columns: Annotated[int, Ge(1), Le(99)] = STARS
    star_spacing_m: Annotated[float, Gt(0), Le(0.1)] = STAR_SPACING_M

    @property
    def named_method(self) -> Method:
        """Method, as far as the settings alone determine it: those of a warp ask for Gauss-Newton."""
        asks_for_warp = self.method == "automatic" and (self.warp is not None or self.rotation)
        return "gauss_newton" if asks_for_warp else self.method

    @property
    def fits_warps(self) -> bool:
        """True if the warp has an effect: the method fits it to each subimage."""
        return self.method in WARPING


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructionSettings(Checked):
    """From displacements to wavefronts."""

    method: Annotated[Literal["zonal", "modal"], Doc("Wavefront: lenslet by lenslet, or as polynomials")] = "modal"
    basis: Annotated[PupilBasis, Doc("Modes: Legendre for a square pupil, Zernike for a circular one")] = "legendre"
    pupil_modes: (
        Annotated[
            int,
            Ge(PUPIL_MODES.start),
            Le(PUPIL_MODES[-1]),
            Doc(
                "Number of modes, at most one for each lenslet. Omitted: as many as the lattice supports,"
                " smoothed according to the noise"
            ),
        ]
        | None
    ) = None
    response: Annotated[bool, Doc("Modelled response, not mean gradients; modal, without rotation")] = True
    sample: Annotated[SampleModel, Doc("Allowed wavefronts: any (free), layers, or by evidence")] = "automatic"
    refine: Annotated[bool, Doc("Refinement of live wavefronts with a forward model")] = False


def obstacle_to_layers(reconstruction: ReconstructionSettings, registration: RegistrationSettings) -> str:
    """Return the setting with which layers cannot be assumed; empty if they can."""
    obstacles = {
        'reconstruction.method = "zonal"': reconstruction.method == "zonal",
        f'reconstruction.basis = "{reconstruction.basis}"': reconstruction.basis != "legendre",
        f"reconstruction.pupil_modes = {reconstruction.pupil_modes}": reconstruction.pupil_modes is not None,
        f'registration.method = "{registration.method}"': not registration.fits_warps,
        'registration.warp = "translation"': registration.warp == "translation",
    }
    return next((setting for setting, is_set in obstacles.items() if is_set), "")
