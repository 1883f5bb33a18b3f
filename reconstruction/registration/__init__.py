"""Registration: displacement of each subimage from the reference, by the method of the settings."""

from importlib import import_module
from typing import cast, get_args

from reconstruction.displacement import RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field
from reconstruction.registration.subimages import LensletModel, ReferenceSubimages
from reconstruction.settings import Method, RegistrationSettings

_MODULES = {"correlation_fft": "correlation"}  # of the other methods, the module has the method's name


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
    method = settings.method
    if method not in get_args(Method):
        raise ReconstructionError(
            f"there is no registration method {method}: it must be one of {', '.join(get_args(Method))}; set"
            " registration.method, for example to gauss_newton"
        )
    module = import_module(f"{__name__}.{_MODULES.get(method, method)}")
    of_sample = {"absorbs": True} if absorbs else {}
    return cast("RegistrationMethod", module.prepare(reference, settings, field, model, **of_sample))
