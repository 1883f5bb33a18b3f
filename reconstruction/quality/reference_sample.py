"""Whether a reference was taken with a sample in the beam.

Without a sample all subimages are alike but for what each lenslet does to its own: shifts, blur, brightness. A sample
stretches and shears them, by amounts that neighbours share. So a reference with a sample shows without a second image,
unless the sample lies at the lenslets, where it only shifts.
"""

import math
from collections.abc import Iterator

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.frame.spline import sample
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.registration.subimages import ReferenceSubimages

# RMS deformation over the field that neighbours share, px. The paper's bench has 0.17 with its sample of 4.2 rad, 0.009
# with 0.25 rad, and without one at most 0.001 at 200 electrons, or 0.014 where a round pupil cuts lenslets.
_DEFORMED_PX = 0.02
_CHANCE = 2.0  # standard errors of the median that are not counted
_STANDARD_ERROR = 1.86  # of a median, times the square root of the number, over the median absolute deviation
_PASSES = 2  # that measure shifts and take them away


def sample_quality(reference: ReferenceSubimages) -> Quality:
    """Judge whether a reference contains a sample; of a point source, of which nothing can be stretched, never."""
    shared_px = shared_deformation_px(reference) if reference.half_width_px > reference.blur_px else 0.0
    if shared_px <= _DEFORMED_PX:
        return Quality()
    return Quality(
        {
            Fault.SAMPLE: f"the reference's subimages are deformed by {shared_px:.2f} px: was the sample in the beam,"
            " or is it the frame?"
        }
    )


def shared_deformation_px(reference: ReferenceSubimages) -> float:
    """RMS over the field of the linear displacements that neighbouring subimages share, beyond those of all, px.

    That of the whole lattice or of one of its halves, whichever is the most; 0 if there are no neighbours.
    """
    deformations = _deformations_px(reference)
    # A third is the mean square of u or v over the field.
    return math.sqrt(max(*map(_shared_square, _halves(deformations)), 0.0) / 3)


def _shared_square(deformations: Floats) -> float:
    """Median product of neighbours, less what is chance; a median ignores lenslets at the edge of the light."""
    products = np.concatenate(
        [
            np.sum(deformations[:-1] * deformations[1:], axis=-1).ravel(),
            np.sum(deformations[:, :-1] * deformations[:, 1:], axis=-1).ravel(),
        ]
    )
    known = products[np.isfinite(products)]
    if not known.size:
        return 0.0
    median = float(np.median(known))
    return median - _CHANCE * _STANDARD_ERROR * float(np.median(np.abs(known - median))) / math.sqrt(known.size)


def _halves(deformations: Floats) -> Iterator[Floats]:
    """The whole lattice and its halves, as the edge of a sample may cut it."""
    rows, columns = (-(-side // 2) for side in deformations.shape[:2])
    yield deformations
    yield from (deformations[:rows], deformations[-rows:], deformations[:, :columns], deformations[:, -columns:])


def _deformations_px(reference: ReferenceSubimages) -> Floats:
    """Displacement of each subimage from the mean one, per half width of the field, px; NaN where unlit.

    (lenslet_row, lenslet_column, 4): along x and y, proportional to u, then to v.
    """
    lit = reference.lit
    u, v = reference.offset_px.T / reference.half_width_px
    position_px, turn = reference.position_px[lit], reference.turn
    for _ in range(_PASSES):
        light, gradient = sample(reference.coefficients, position_px)
        brightness = np.maximum(light.sum(axis=1), np.finfo(np.float32).tiny)[:, None]
        light, mean_gradient = light / brightness, (gradient / brightness[..., None]).mean(axis=0) @ turn.T
        mean = light.mean(axis=0)
        moved = [along * position for position in (u, v, np.ones_like(u)) for along in mean_gradient.T]
        images = np.stack([*moved, mean, mean * u, mean * v, np.full_like(mean, mean.mean())])
        found = (light - mean) @ np.linalg.pinv(images)
        position_px = position_px - found[:, None, 4:6] @ turn
    deformations = np.full((lit.size, 4), np.nan)
    deformations[lit] = found[:, :4]
    return deformations.reshape(*reference.lenslets, 4)
