"""Methods in the tables: their mask, registration and reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from reconstruction.settings import ReconstructionSettings, RegistrationSettings

Mask = Literal["square", "stars"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """One row of a table."""

    mask: Mask = "square"
    registration: RegistrationSettings
    reconstruction: ReconstructionSettings

    @property
    def is_peer(self) -> bool:
        """True if it needs the extra `svwfs[peers]`."""
        return self.registration.method in {"itk_affine", "demons", "ffd"}


ZONAL = ReconstructionSettings(method="zonal")
MODAL = ReconstructionSettings(method="modal", pupil_modes=45)  # the paper's
MODAL_MANY = ReconstructionSettings(method="modal", pupil_modes=91)
_ITK = RegistrationSettings(method="itk_affine")
_AFFINE = RegistrationSettings(warp="affine")
_QUADRATIC = RegistrationSettings(warp="quadratic")
_CUBIC = RegistrationSettings(warp="cubic")

METHODS: dict[str, Method] = {
    "stars_zonal": Method(mask="stars", registration=RegistrationSettings(method="centroids"), reconstruction=ZONAL),
    "correlation_zonal": Method(registration=RegistrationSettings(method="correlation"), reconstruction=ZONAL),
    "itk_affine_zonal": Method(registration=_ITK, reconstruction=ZONAL),
    "itk_affine_modal": Method(registration=_ITK, reconstruction=MODAL),
    "block_flow_zonal": Method(registration=RegistrationSettings(method="block_flow"), reconstruction=ZONAL),
    "demons_zonal": Method(registration=RegistrationSettings(method="demons"), reconstruction=ZONAL),
    "ffd_zonal": Method(registration=RegistrationSettings(method="ffd"), reconstruction=ZONAL),
    "affine_zonal": Method(registration=_AFFINE, reconstruction=ZONAL),
    "affine_modal": Method(registration=_AFFINE, reconstruction=MODAL),
    "quadratic_zonal": Method(registration=_QUADRATIC, reconstruction=ZONAL),
    "quadratic_modal": Method(registration=_QUADRATIC, reconstruction=MODAL_MANY),
    "cubic_zonal": Method(registration=_CUBIC, reconstruction=ZONAL),
    "cubic_modal": Method(registration=_CUBIC, reconstruction=MODAL_MANY),
}

# Minimum, maximum and mean over the views in the paper's tables, rad.
PAPER_TABLE_1 = {
    "stars_zonal": (0.108, 0.197, 0.147),
    "itk_affine_zonal": (0.275, 0.589, 0.421),
    "itk_affine_modal": (0.383, 0.465, 0.417),
    "correlation_zonal": (0.511, 1.260, 0.830),
}
PAPER_TABLE_2 = {
    "itk_affine_zonal": (0.558, 2.450, 1.378),
    "itk_affine_modal": (0.617, 2.449, 1.461),
    "correlation_zonal": (1.850, 10.228, 5.984),
}
