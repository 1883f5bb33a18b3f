"""What of a measurement is recorded: so little that ten seconds of it can be kept in memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.measurement.calibration import Calibration
from app.measurement.measurement import LightState, Measurement
from drivers.interface import Frame
from reconstruction.arrays import Floats
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import rms


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """A frame, what came of it, and what is needed to make the same of it again."""

    frame: Frame
    lost: int  # frames lost just before it
    light: LightState | None
    problem: str
    calibration: Calibration | None
    bias: Floats | None  # px, (lenslet_row, lenslet_column, field_mode, xy)
    bias_age_s: float | None
    start: Floats | None  # px, as the bias: where the registration began
    displacement: Floats | None  # likewise: what it found
    coefficients: Floats | None  # rad, (pupil_mode, field_mode)
    views: Floats | None  # rad, (view_row, view_column, lenslet_row, lenslet_column)
    valid: int | None

    @classmethod
    def of(cls, measurement: Measurement, lost: int) -> Record:
        """Pick it from a measurement, without a copy."""
        wavefront, registered, start = measurement.wavefront, measurement.registered, measurement.start
        solution = None if wavefront is None else wavefront.solution
        return cls(
            frame=measurement.frame,
            lost=lost,
            light=measurement.light,
            problem=measurement.problem,
            calibration=measurement.calibration,
            bias=measurement.refinement.bias,
            bias_age_s=None if measurement.refinement.bias is None else measurement.refinement.age_s,
            start=None if start is None else start.coefficients,
            displacement=None if registered is None else registered.coefficients,
            coefficients=solution.coefficients if isinstance(solution, ModalSolution) else None,
            views=None if wavefront is None else wavefront.views,
            valid=None if registered is None else int(np.count_nonzero(registered.valid)),
        )

    @property
    def nbytes(self) -> int:
        """Memory that it holds, but for what it shares with others."""
        arrays = (self.frame.pixels, self.displacement, self.coefficients, self.views)
        return sum(array.nbytes for array in arrays if array is not None)

    @property
    def rms_rad(self) -> float | None:
        """RMS of the wavefront, mean over the views that lie in the field; None without a wavefront."""
        if self.views is None:
            return None
        values = rms(self.views)
        known = values[np.isfinite(values)]
        return float(known.mean()) if known.size else None
