"""Which method compares the subimages of a frame with those of the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from reconstruction.displacement import Estimator
from reconstruction.geometry import Field, centered_steps, require
from reconstruction.modes.field_modes import FieldModes, LegendreModes, SampledModes, ZernikeModes
from reconstruction.registration.gauss_newton.method import GaussNewton
from reconstruction.registration.peers.centroids import Centroids
from reconstruction.registration.peers.correlation import Correlation
from reconstruction.registration.subimages import ReferenceSubimages

Warp = Literal["translation", "affine", "quadratic", "cubic"]
Method = Literal[
    "gauss_newton", "correlation", "correlation_fft", "centroids", "itk_affine", "block_flow", "demons", "ffd"
]
FIELD_MODES: dict[Warp, int] = {"translation": 1, "affine": 3, "quadratic": 6, "cubic": 10}


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationSettings:
    """How subimages are compared, how they may move, and where the stars are if the source has any."""

    method: Method = "gauss_newton"
    warp: Warp | None = None  # affine or quadratic, as the noise allows; quadratic where that is not known
    conserve_flux: bool = True
    threads: int = 2  # gauss_newton: that share the lenslets
    flow: Literal["views", "warp"] = (
        "views"  # block_flow, demons, ffd: kept as it is at the views, or fitted by the warp
    )
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


def prepare_registration(reference: ReferenceSubimages, settings: RegistrationSettings, field: Field) -> Estimator:
    """Prepare the method that the settings ask for, for one reference."""
    if settings.method in {"correlation", "correlation_fft"}:
        return Correlation(reference, method="fft" if settings.method == "correlation_fft" else "square_difference")
    if settings.method == "centroids":
        spacing = settings.star_spacing_m / field.half_width_m
        columns, rows = centered_steps(settings.star_columns), centered_steps(settings.star_rows)
        return Centroids(reference, star_x=columns * spacing, star_y=rows * spacing)
    modes = (ZernikeModes if field.shape == "circle" else LegendreModes)(FIELD_MODES[settings.warp or "quadratic"])
    if settings.method == "gauss_newton":
        return GaussNewton(reference, modes, conserve_flux=settings.conserve_flux, threads=settings.threads)
    if settings.method == "itk_affine":
        from reconstruction.registration.peers.itk_affine import ItkAffine

        return ItkAffine(reference)
    flow_modes: FieldModes = modes
    if settings.flow == "views":
        flow_modes = SampledModes(field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m)
    if settings.method == "block_flow":
        from reconstruction.registration.peers.block_flow import BlockFlow

        return BlockFlow(reference, flow_modes)
    from reconstruction.registration.peers.deformable import Demons, FreeForm

    return (Demons if settings.method == "demons" else FreeForm)(reference, flow_modes)
