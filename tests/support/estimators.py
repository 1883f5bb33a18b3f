"""Estimators of small benches."""

from __future__ import annotations

import numpy as np

from app.bench.config import Bench
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.estimator import Estimator
from reconstruction.arrays import Counts
from reconstruction.reconstructor import Reconstructor


def estimator_with(reconstructor: Reconstructor, bench: Bench, reference: Counts) -> Estimator:
    """Estimator of a bench with a reconstructor that is prepared already."""
    calibration = Calibration(
        bench=bench, dark=None, reference=Average.of_image(reference), lattice=reconstructor.lattice, full_scale=np.inf
    )
    estimator = Estimator(calibration)
    vars(estimator)["reconstructor"] = reconstructor
    return estimator
