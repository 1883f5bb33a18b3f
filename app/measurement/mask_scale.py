"""The mask as a ruler: its image in a reference gives the scale of every wavefront.

A subimage is as large as the mask times the distance of the camera from the lenslets over the collimator's focal
length. A camera 4 % out of focus, or a wrong focal length in the bench, scales every wavefront as much, and no
residual shows it. The mean subimage is compared with that of the bench's mask (`[simulation.source]`), enlarged, turned
and mirrored; its light, position and a further blur are fitted with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import scipy  # which loads its parts when they are used
from scipy import ndimage

from app.bench.imaging_model import lenslet_image
from app.cache import kept_while_alive
from reconstruction.errors import ReconstructionError
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.registration.response import mean_subimage
from reconstruction.registration.subimages import ReferenceSubimages
from simulated_devices.optics.source import SourcePoints, source_points
from simulated_devices.settings import Simulation, Source

if TYPE_CHECKING:
    from collections.abc import Callable

    from app.bench.config import Bench
    from app.measurement.averages import Average
    from app.measurement.calibration import Calibration
    from reconstruction.arrays import Floats, Image

_RANGE = (0.9, 1.1)  # of the scale that is searched
_STEP = 1e-3  # of the scale, for its derivative
_LIKE = 0.1  # residual over the contrast below which a reference shows the mask
_SURE = 0.03  # ... below which it is this mask as the bench has it; right ones have 0.021 at most
_BETTER = 0.7  # residual of another orientation over that of the bench's
_TOLERANCE = 0.01
_PITCH_TOLERANCE = 0.03  # of the pitch; light that is not quite collimated changes it by less
_ORIENTATIONS = {  # how the mask lies in the image, and its points' matrix
    "": ((1, 0), (0, 1)),
    "mirrored left to right": ((-1, 0), (0, 1)),
    "mirrored top to bottom": ((1, 0), (0, -1)),
    "turned by 180 degrees": ((-1, 0), (0, -1)),
    "turned by 90 degrees": ((0, -1), (1, 0)),
    "turned by -90 degrees": ((0, 1), (-1, 0)),
    "mirrored across its diagonal": ((0, 1), (1, 0)),
    "mirrored across its other diagonal": ((0, -1), (-1, 0)),
}


@dataclass(frozen=True, slots=True)
class MaskScale:
    """Size and orientation of the mask's image in a reference."""

    mask: str
    scale: float  # of the image, over half_width_m * lenslet_focal_length_m / collimator_focal_length_m
    sigma: float  # standard error of the scale
    orientation: str  # empty as the bench has it
    misfit: float = 0.0  # what the model leaves of the image, over its contrast

    @property
    def faults(self) -> list[str]:
        """Sentences on what is wrong with the bench."""
        sentences = []
        if abs(self.scale - 1) > max(_TOLERANCE, 3 * self.sigma):
            off = f"{100 * abs(self.scale - 1):.1f} % {'larger' if self.scale > 1 else 'smaller'}"
            sentences.append(
                f"the image of the mask {self.mask} is {off} than the bench's lengths say, which scales every"
                " wavefront: check the focus, lenslet_focal_length_m, collimator_focal_length_m, and half_width_m"
            )
        if self.orientation:
            sentences.append(f"the mask {self.mask} is {self.orientation}: mount it or the camera as the bench has it")
        return sentences


def mask_scale(bench: Bench, reference: Image) -> MaskScale | None:
    """Measure the bench's mask in a reference (row, column), counts, in 0.1 s or more; None if that does not show it.

    The bench has the lattice of the reference. `ReconstructionError` if that shows nothing.
    """
    if bench.lattice is None:
        raise ValueError("the bench needs a lattice")
    source, field = bench.simulation.source, bench.field
    points = source_points(source.mask, source, object_samples=bench.simulation.object_samples)
    subimage, _ = mean_subimage(ReferenceSubimages(reference, sensor=bench.sensor, lattice=bench.lattice, field=field))
    orientation, best, seen = "", (math.inf, 1.0, 0.0), set[bytes]()
    for name, matrix in _ORIENTATIONS.items():
        if best[0] < _SURE:
            break
        turned = _turned(points, matrix)
        if (shape := np.round(turned.area_m2 / points.area_m2.max(), 6).tobytes()) in seen:
            continue
        seen.add(shape)
        found = _fitted(partial(_modelled, bench, turned, len(subimage)), subimage)
        if found[0] < (best[0] * _BETTER if name else best[0]):
            orientation, best = name, found
    misfit, scale, sigma = best
    return MaskScale(source.mask, scale, sigma, orientation, misfit) if misfit < _LIKE else None


@kept_while_alive(maxsize=4)  # another setting of registration or reconstruction does not change it
def _kept_scale(reference: Average, dark: Average | None, bench: Bench) -> MaskScale | None:
    light = reference.mean if dark is None else reference.mean - dark.mean
    try:
        return mask_scale(bench, light)
    except (ReconstructionError, ValueError, OSError):  # no image of a mask, or its file is not there
        return None


def scale_quality(calibration: Calibration) -> Quality:
    """Judge by the lattice's pitch and the image of the mask whether the bench's lengths are those of a reference.

    The image is not checked if the reference does not clearly show the mask (an octagon looks like a circle 3 %
    smaller, with a misfit of 4 %), or if the bench does not describe it: `[simulation.source]` is left out, and its
    square is not as large as the field.
    """
    bench, source = calibration.bench, calibration.bench.simulation.source
    pitch = calibration.lattice.pitch_px / bench.sensor.lenslet_pitch_px
    if abs(pitch - 1) > _PITCH_TOLERANCE:
        off = f"{100 * abs(pitch - 1):.0f} % {'larger' if pitch > 1 else 'smaller'}"
        return Quality.of(
            Fault.SCALE,
            f"the lenslets' pitch on the camera is {off} than the bench's lengths say, which scales every wavefront:"
            " check lenslet_pitch_m and pixel_pitch_m",
        )
    if source == Source() and source.half_width_m != bench.field.half_width_m:
        return Quality()
    simulation = Simulation(source=source, object_samples=bench.simulation.object_samples)
    relevant = type(bench)(
        sensor=bench.sensor,
        field=bench.field,
        lattice=calibration.lattice,
        camera=bench.camera_model,
        simulation=simulation,
    )
    found = _kept_scale(calibration.reference, calibration.dark, relevant)
    is_clear = found is not None and found.misfit < _SURE
    return Quality.of(Fault.SCALE, "; ".join(found.faults) if is_clear else "")


def _turned(points: SourcePoints, matrix: tuple[tuple[int, int], tuple[int, int]]) -> SourcePoints:
    """Points mirrored or turned by multiples of 90 degrees, in the order of their new positions."""
    position_m = points.position_m @ np.array(matrix, np.float64).T
    order = np.lexsort(np.round(position_m, 12).T)
    return SourcePoints(position_m=position_m[order], area_m2=points.area_m2[order])


def _modelled(bench: Bench, points: SourcePoints, width: int, scale: float) -> Floats:
    """Subimage of points enlarged by a scale, (width, width)."""
    enlarged = replace(points, position_m=points.position_m * scale)
    return lenslet_image(bench, enlarged, width, 2 * math.ceil(width / bench.sensor.blur_px / 2 + 1)).image()


def _fitted(model: Callable[[float], Floats], subimage: Floats) -> tuple[float, float, float]:
    """Residual over the contrast, scale, and its standard error, of the model that fits a subimage (width, width) best.

    Variable projection (G. H. Golub and V. Pereyra 1973): light, background, shift and blur of the image are linear
    and projected out, so that only the scale is searched. The model is moved by whole pixels beforehand, since the
    lattice of a mask beside the middle lies where its light is, and not the mask's middle.
    """
    data = subimage.ravel() / np.std(subimage)
    start = model(1.0)
    most = len(subimage) - 1  # px of shift; `scipy.signal` would take a third of a second to import
    one, other = (np.fft.rfft2(image - np.mean(image), 2 * (2 * most + 1,)) for image in (subimage, start))
    likeness = np.fft.irfft2(one * other.conj(), 2 * (2 * most + 1,))
    moved = (np.array(np.unravel_index(np.argmax(likeness), likeness.shape)) + most) % (2 * most + 1) - most

    def residual(scale: float) -> Floats:
        """Return what light, background, shift and blur of the model leave of the data, (pixel,)."""
        image = ndimage.shift(model(scale), moved, order=0, mode="nearest")
        dy, dx = np.gradient(image)
        nuisance = np.stack([image, np.ones_like(image), dx, dy, ndimage.laplace(image)]).reshape(5, -1).T
        basis, _ = np.linalg.qr(nuisance / np.linalg.norm(nuisance, axis=0))
        return np.asarray(data - basis @ (basis.T @ data))

    found = scipy.optimize.minimize_scalar(
        lambda scale: float(np.sum(residual(scale) ** 2)),
        bounds=_RANGE,
        method="bounded",
        options={"xatol": _STEP / 10},
    )
    scale = float(found.x)
    ahead, behind = residual(scale + _STEP), residual(scale - _STEP)
    slope = np.linalg.norm(ahead - behind) / (2 * _STEP)
    misfit = math.sqrt(float(found.fun) / data.size)
    return misfit, scale, misfit / max(float(slope), np.finfo(float).tiny)
