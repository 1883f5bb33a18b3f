"""Registration: displacement of each subimage from the reference, by the method of the settings."""

from dataclasses import replace
from importlib import import_module
from typing import cast, get_args

from reconstruction.displacement import RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field
from reconstruction.registration.centroids import spot_sigma_px
from reconstruction.registration.subimages import LensletModel, ReferenceSubimages
from reconstruction.settings import Method, RegistrationSettings


def chosen(settings: RegistrationSettings, reference: ReferenceSubimages) -> tuple[RegistrationSettings, str]:
    """Settings with the method that suits a reference if they leave it open, and why; else themselves, and "".

    A spot shows where it lies, and no warp.
    """
    if settings.named_method != "automatic":
        return replace(settings, method=settings.named_method), ""
    sigma_px = spot_sigma_px(reference)
    if sigma_px:
        spots = replace(settings, method="centroids", star_rows=1, star_columns=1)
        return spots, f"centroids, because each lenslet of the reference shows one spot (sigma {sigma_px:.1f} px)"
    return replace(settings, method="gauss_newton"), "gauss_newton, because the reference shows pictures, not spots"


def prepare_registration(
    reference: ReferenceSubimages,
    settings: RegistrationSettings,
    field: Field,
    model: LensletModel | None = None,
    *,
    absorbs: bool = False,
) -> RegistrationMethod:
    """Prepare the method of the settings for one reference: `prepare` of the module of its name.

    `model` is that of the reference's lenslets, if there is one that fits, which the method `gauss_newton` uses behind
    a sample that `absorbs`.
    """
    settings, _ = chosen(settings, reference)
    method = settings.method
    if method not in get_args(Method):
        raise ReconstructionError(
            f"there is no registration method {method}: it must be one of {', '.join(get_args(Method))}; set"
            " registration.method, for example to gauss_newton"
        )
    module = import_module(f"{__name__}.{method}")
    of_sample = {"absorbs": True} if absorbs else {}
    return cast("RegistrationMethod", module.prepare(reference, settings, field, model, **of_sample))
