"""Which method compares the subimages of a frame with those of the reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from reconstruction.displacement import Estimator
from reconstruction.field_modes import LegendreModes, ZernikeModes
from reconstruction.gauss_newton import GaussNewton
from reconstruction.geometry import Field
from reconstruction.subimages import ReferenceSubimages

Warp = Literal["translation", "affine", "quadratic", "cubic"]
FIELD_MODES: dict[Warp, int] = {"translation": 1, "affine": 3, "quadratic": 6, "cubic": 10}


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationSettings:
    """How the subimages may move."""

    warp: Warp = "quadratic"
    conserve_flux: bool = True


def prepare_registration(reference: ReferenceSubimages, settings: RegistrationSettings, field: Field) -> Estimator:
    """Prepare the method that the settings ask for, for one reference."""
    modes = (ZernikeModes if field.shape == "circle" else LegendreModes)(FIELD_MODES[settings.warp])
    return GaussNewton(reference, modes, conserve_flux=settings.conserve_flux)
