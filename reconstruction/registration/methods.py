"""Choice of the registration method."""

from typing import get_args

from reconstruction.displacement import RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, centered_steps
from reconstruction.modes.field_modes import FieldModes, LegendreModes, SampledModes, ZernikeModes
from reconstruction.registration.gauss_newton.estimator import GaussNewton
from reconstruction.registration.peers.centroids import Centroids
from reconstruction.registration.peers.correlation import Correlation
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import FIELD_MODES, Method, RegistrationSettings


def prepare_registration(
    reference: ReferenceSubimages, settings: RegistrationSettings, field: Field
) -> RegistrationMethod:
    """Prepare the method of the settings for one reference."""
    if settings.method in {"correlation", "correlation_fft"}:
        return Correlation(reference, method="fft" if settings.method == "correlation_fft" else "square_difference")
    if settings.method == "centroids":
        spacing = settings.star_spacing_m / field.half_width_m
        columns, rows = centered_steps(settings.star_columns), centered_steps(settings.star_rows)
        try:
            return Centroids(reference, star_x=columns * spacing, star_y=rows * spacing)
        except ValueError as error:
            raise ReconstructionError(f"registration.star_spacing_m does not suit the lenslets: {error}") from error
    modes = (ZernikeModes if field.shape == "circle" else LegendreModes)(FIELD_MODES[settings.warp or "quadratic"])
    if settings.method == "gauss_newton":
        return GaussNewton(
            reference,
            modes,
            conserve_flux=field.neglect_propagation,
            rotation=settings.rotation,
            threads=settings.threads,
        )
    if settings.method == "itk_affine":
        from reconstruction.registration.peers.simple_itk import ItkAffine

        return ItkAffine(reference)
    flow_modes: FieldModes = modes
    if settings.flow == "views":
        flow_modes = SampledModes(field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m)
    if settings.method == "block_flow":
        from reconstruction.registration.peers.block_flow import BlockFlow

        return BlockFlow(reference, flow_modes)
    if settings.method in {"demons", "ffd"}:
        from reconstruction.registration.peers.simple_itk import Demons, FreeForm

        return (Demons if settings.method == "demons" else FreeForm)(reference, flow_modes)
    known = ", ".join(get_args(Method))
    raise ReconstructionError(f"there is no registration method {settings.method}: it must be one of {known}")
