"""Classification of each lenslet (converged, dark, ...), common to all registration methods."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Mask
from reconstruction.displacement import CovarianceSource, Displacement, Outcome
from reconstruction.modes.field_modes import FieldModes
from reconstruction.registration.subimages import DARK_CONTRAST, ReferenceSubimages


def classify_lenslets(
    reference: ReferenceSubimages,
    modes: FieldModes,
    coefficients: Floats,
    *,
    covariance: Floats | CovarianceSource,
    residual_rms: Floats,
    chi_square: Floats | None = None,
    contrast: NDArray[np.floating[Any]],
    faults: dict[Outcome, Mask],
) -> Displacement:
    """Classify L lenslets and arrange the results on the lattice, NaN where lost.

    coefficients c_q, px, (L, xy, Q); covariance (L, Q, xy, Q, xy), px^2; residual_rms (L,) over the contrast of the
    reference's best subimage; contrast (L,) of the frame's subimages. `faults` are the losses (L,) found by the method;
    of several the last counts, and darkness above all.
    """
    lost = np.zeros(len(coefficients), np.bool_)
    for fault in faults.values():
        lost |= fault
    range_used = reference.range_used(np.where(lost[:, None, None], 0, coefficients), modes)
    outcome = np.full(len(coefficients), Outcome.CONVERGED, np.int8)
    outcome[range_used > 1] = Outcome.LEFT_CELL
    for reason, fault in faults.items():
        outcome[fault] = reason
    contrast = np.where(np.isfinite(contrast), contrast, 0)
    outcome[~reference.lit | ~(contrast > DARK_CONTRAST * np.median(contrast[reference.lit]))] = Outcome.DARK
    outcome[reference.off_camera] = Outcome.OFF_CAMERA
    outcome[reference.excluded] = Outcome.EXCLUDED
    lost = outcome != Outcome.CONVERGED
    far = outcome == Outcome.LEFT_CELL

    def arrange(values: Floats, keep: Mask) -> Floats:
        kept = values
        if not keep.all():
            kept = np.full_like(values, np.nan)
            kept[keep] = values[keep]
        return kept.reshape(*reference.lenslets, *values.shape[1:])

    # A source in place of the covariance is resolved on first access.
    kept = arrange(covariance, ~lost) if isinstance(covariance, np.ndarray) else cast("Floats", covariance.kept(~lost))
    unknown = np.full(len(coefficients), np.nan)
    return Displacement(
        modes=modes,
        coefficients=arrange(np.swapaxes(coefficients, 1, 2), ~lost),
        covariance=kept,
        outcome=outcome.reshape(reference.lenslets),
        residual_rms=arrange(residual_rms, ~lost),
        chi_square=arrange(unknown if chi_square is None else chi_square, ~lost),
        range_used=arrange(range_used, ~lost | far & (range_used > 0)),
    )
