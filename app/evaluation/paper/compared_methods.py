"""Methods in the tables, and their wavefronts, cached by everything they depend on."""

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

import reconstruction
from app.bench.config import Bench, write_bench
from app.cache import Arrays, cached
from app.evaluation.paper import nonrigid_methods
from app.evaluation.paper.frame_pairs import FramePair, Mask
from app.measurement.calibration import Calibration
from reconstruction.arrays import Floats
from reconstruction.pipeline import OwnMethods, OwnRegistration
from reconstruction.settings import ReconstructionSettings, RegistrationSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """One row of a table."""

    mask: Mask = "square"
    registration: RegistrationSettings = RegistrationSettings()
    own: OwnRegistration | None = None  # in place of that of the settings
    reconstruction: ReconstructionSettings

    @property
    def is_peer(self) -> bool:
        """True if it needs the extra `svwfs[peers]`."""
        return self.registration.method == "itk_affine" or self.own in {
            nonrigid_methods.Demons,
            nonrigid_methods.FreeForm,
        }


ZONAL = ReconstructionSettings(method="zonal")
MODAL = ReconstructionSettings(method="modal", pupil_modes=45)  # the paper's
MODAL_MANY = ReconstructionSettings(method="modal", pupil_modes=91)
_ITK = RegistrationSettings(method="itk_affine")
_AFFINE = RegistrationSettings(warp="affine", rotation=True)  # the paper's, with six parameters
_GRADIENT_AFFINE = RegistrationSettings(warp="affine")  # with five: subimages do not rotate
_QUADRATIC = RegistrationSettings(warp="quadratic")
_CUBIC = RegistrationSettings(warp="cubic")

METHODS: dict[str, Method] = {
    "stars_zonal": Method(mask="stars", registration=RegistrationSettings(method="centroids"), reconstruction=ZONAL),
    "correlation_zonal": Method(registration=RegistrationSettings(method="correlation"), reconstruction=ZONAL),
    "itk_affine_zonal": Method(registration=_ITK, reconstruction=ZONAL),
    "itk_affine_modal": Method(registration=_ITK, reconstruction=MODAL),
    "block_flow_zonal": Method(own=nonrigid_methods.BlockFlow, reconstruction=ZONAL),
    "demons_zonal": Method(own=nonrigid_methods.Demons, reconstruction=ZONAL),
    "ffd_zonal": Method(own=nonrigid_methods.FreeForm, reconstruction=ZONAL),
    "affine_zonal": Method(registration=_AFFINE, reconstruction=ZONAL),
    "affine_modal": Method(registration=_AFFINE, reconstruction=MODAL),
    "affine_gradient_zonal": Method(registration=_GRADIENT_AFFINE, reconstruction=ZONAL),
    "affine_gradient_modal": Method(registration=_GRADIENT_AFFINE, reconstruction=MODAL),
    "quadratic_zonal": Method(registration=_QUADRATIC, reconstruction=ZONAL),
    "quadratic_modal": Method(registration=_QUADRATIC, reconstruction=MODAL_MANY),
    "cubic_zonal": Method(registration=_CUBIC, reconstruction=ZONAL),
    "cubic_modal": Method(registration=_CUBIC, reconstruction=MODAL_MANY),
    "automatic": Method(registration=RegistrationSettings(), reconstruction=ReconstructionSettings()),
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


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """The wavefronts of one frame by one method."""

    views: Floats  # rad, (view_row, view_column, lenslet_row, lenslet_column)
    lost: int  # lenslets without a displacement
    seconds: float  # for the frame, without preparing the reference


def reconstructed(bench: Bench, frames: Mapping[str, FramePair], method: Method) -> MethodResult:
    """Reconstruct the frame of the method's mask; a changed frame, setting or reconstruction package recomputes."""
    pair, stars = frames[method.mask], bench.simulation.source
    registration = replace(
        method.registration,
        star_rows=stars.star_rows,
        star_columns=stars.star_columns,
        star_spacing_m=stars.star_spacing_m,
    )
    bench = replace(bench, registration=registration, reconstruction=method.reconstruction)
    own = OwnMethods(method.own)
    kept = cached("paper", _fingerprint(bench, own, pair), lambda: _reconstruct(bench, own, pair))
    return MethodResult(kept["views"], int(kept["lost"]), float(kept["seconds"]))


def _reconstruct(bench: Bench, own: OwnMethods, pair: FramePair) -> Arrays:
    """Return the fields of `MethodResult`."""
    lattice = bench.design_lattice(*pair.reference.shape)
    dark = np.zeros_like(pair.reference)
    reconstructor = Calibration.of_images(bench, pair.reference, dark=dark, lattice=lattice, own=own).reconstructor()
    start_s = time.perf_counter()
    wavefront = reconstructor(pair.frame)
    seconds = time.perf_counter() - start_s
    lost = np.count_nonzero(~wavefront.displacement.valid)
    return {"views": wavefront.views, "lost": np.array(lost), "seconds": np.array(seconds)}


def _fingerprint(bench: Bench, own: OwnMethods, pair: FramePair) -> str:
    digest = hashlib.sha256(f"{write_bench(bench)}{own}".encode())
    digest.update(_source_code())
    digest.update(pair.reference.tobytes())
    digest.update(pair.frame.tobytes())
    return digest.hexdigest()


@cache
def _source_code() -> bytes:
    """The source code of `reconstruction` and of the paper's non-rigid methods."""
    folder = Path(str(reconstruction.__file__)).parent
    return b"".join(path.read_bytes() for path in (*sorted(folder.rglob("*.py")), Path(nonrigid_methods.__file__)))
