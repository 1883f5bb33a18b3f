"""Whether the light of subimages grows with their size, as it does in real light (docs/brightness.md).

A layer stretches subimages. In real light their brightness stays, so that their light grows with their area; in the
paper's world their light stays.
"""

import math
from collections.abc import Iterator

import numpy as np

from reconstruction.arrays import Floats, Mask
from reconstruction.displacement import Displacement
from reconstruction.quality.verdict import Fault

_BETWEEN = 0.5  # of the slope of log light over log area: 1 in real light, 0 in the paper's world
_LEAST_GROWTH = 0.002  # standard deviation of log area; less decides nothing
_CERTAIN = 5.0  # standard errors of the slope
_ALIKE = 25.0  # neighbouring lenslets, over which absorption and uneven light are alike
_LEAST_LENSLETS = 25
_MOST_NOISE = 0.3  # of the variance of log area
_REAL = "real light: remove neglect_propagation from the bench, or conserve_flux of version 0.2"
_NEGLECTED = "the paper's simulation: set field.neglect_propagation = true, or is the light uneven?"


def propagation_faults(
    displacement: Displacement, lit: Mask, light: Floats, half_width_px: float, *, neglect_propagation: bool
) -> Iterator[tuple[Fault, str]]:
    """Yield a fault if the frame's light is surely of the other world than is assumed.

    `lit` (lenslet_row, lenslet_column) marks lit lenslets, `light` (lit lenslet,) is theirs over that in the reference.
    """
    known = displacement.valid[lit] & (light > 0)
    gradients = getattr(displacement.modes, "gradients", None)  # interpolation between stars has none
    if gradients is None or np.count_nonzero(known) < _LEAST_LENSLETS:
        return
    weights = gradients(0.0, 0.0) / half_width_px  # (field_mode, xy)
    area = np.tensordot(displacement.coefficients[lit][known], weights, axes=2)
    area -= area.mean()
    size, count = float(area @ area), len(area)
    if size < count * _LEAST_GROWTH**2:
        return
    log_light = np.log(light[known])
    slope = float(area @ log_light) / size
    if (slope > _BETWEEN) != neglect_propagation:
        return
    left = log_light - log_light.mean() - slope * area
    sigma = math.sqrt(_ALIKE * float(left @ left) / (count - 2) / size)
    noise = float(np.sum(displacement.variance[lit][known] * weights**2)) / size  # takes longest
    if noise < _MOST_NOISE and abs(slope - _BETWEEN) > max(_CERTAIN * sigma, _MOST_NOISE):
        change, cause = ("grows", _REAL) if neglect_propagation else ("does not grow", _NEGLECTED)
        yield Fault.PROPAGATION, f"the light of the subimages {change} with their size: this is {cause}"
