"""Refinement: subtracts the estimator's bias, found with a forward model (defect correction).

The model renders a frame of the estimated wavefront, which is registered against the model's own reference. The
displacements found, minus those that the solve expects, are the estimator's bias at this wavefront. It is subtracted
from the measured displacements, and the wavefront is estimated again. Only a difference enters, so that the model may
be coarse. A round is retained if it brings the modelled displacements closer to the measured ones.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Floats, Image, PointField
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.modes.field_modes import PolynomialModes
from reconstruction.modes.pupil_modes import PupilGrid, PupilModes
from reconstruction.reconstructor import Reconstructor
from reconstruction.runtime.deferred import Remembered
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront, mean_rms

_SETTLED_RAD = 1e-3  # stop below this change


class ImagingModel(Protocol):
    """Forward model of the bench, supplied by the caller."""

    sample_x_m: Floats  # pupil positions of the phase samples: all combinations of these ...
    sample_y_m: Floats  # ... and these

    def image(self, field: PointField | None) -> Image:
        """Image (row, column) of the source behind a sample; the reference if `field` is None."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Bias:
    """Systematic error of the estimator at one wavefront."""

    displacement: Floats  # measured minus expected, px, (lenslet_row, lenslet_column, field_mode, xy)
    modelled: Floats  # displacements of the model's image, px, as `displacement`; NaN where lost
    views: Floats  # the wavefront, rad, (view_row, view_column, lenslet_row, lenslet_column)

    def misfit_px(self, displacement: Displacement) -> float:
        """RMS difference of the wavefront's measured displacements, before any bias, and the modelled ones."""
        return _misfit_px(displacement, self, _known(displacement, self))


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """One round of refinement."""

    wavefront: Wavefront
    bias: Bias
    change_rad: float  # mean over the views of the RMS change


class Refinement:
    """Refines one reconstructor's wavefronts; the model's reference is rendered and prepared once."""

    def __init__(self, reconstructor: Reconstructor, model: ImagingModel) -> None:
        self._reconstructor, self._model = reconstructor, model
        reference = model.image(None)
        self._register = reconstructor.registration_for(reference)
        self._unsaturated = np.zeros(reference.shape, np.bool_)
        self._grids = Remembered[PupilGrid](2)

    @cached_property
    def _absorbing(self) -> "Refinement":
        return Refinement(self._reconstructor.absorbing, self._model)

    def bias(self, wavefront: Wavefront) -> Bias:
        """Find the bias at a wavefront: one rendered image and its registration."""
        reconstructor, displacement, solution = self._reconstructor, wavefront.displacement, wavefront.solution
        if displacement.absorbs and reconstructor.absorbing is not reconstructor:
            return self._absorbing.bias(wavefront)
        if not (wavefront.sample.ratios and isinstance(solution, ModalSolution)):
            solution = reconstructor.smooth(displacement, weights=reconstructor.weights_of(displacement))
        modes = displacement.modes
        if not isinstance(modes, PolynomialModes):
            raise ReconstructionError("refinement needs a registration in polynomials of the field position")
        with one_blas_thread():  # the model's own threads would wait for those of BLAS
            image = self._model.image(self._field(solution, modes))
        found = self._register(image, saturated=self._unsaturated)
        # A lenslet lost in the model's image is left uncorrected.
        bias = np.where(found.valid[..., None, None], found.coefficients - solution.displacement, 0.0)
        return Bias(bias, found.coefficients, wavefront.views)

    def rounds(self, displacement: Displacement, most: int, sample: AssumedSample = FREE) -> Iterator[Round]:
        """Refine displacements in up to `most` rounds; stop before one that fits the measured ones worse."""
        bias = self.bias(self._reconstructor.solve(displacement, sample=sample))
        for _ in range(most):
            wavefront = self._reconstructor.solve(displacement, bias=bias.displacement, sample=sample)
            following = self.bias(wavefront)
            common = _known(displacement, bias, following)
            if not _misfit_px(displacement, following, common) < _misfit_px(displacement, bias, common):
                return
            change_rad = mean_rms(wavefront.views - bias.views)
            yield Round(wavefront, bias, change_rad)
            if change_rad < _SETTLED_RAD:
                return
            bias = following

    def _prepared_grid(self, modes: PupilModes) -> PupilGrid:
        return PupilGrid(modes, self._reconstructor.sensor, self._model.sample_x_m, self._model.sample_y_m)

    def _field(self, solution: ModalSolution, modes: PolynomialModes) -> PointField:
        """Light of each object point on the pupil samples, gathered by the wavefront's change over the field."""
        bench_field, coefficients = self._reconstructor.field, solution.coefficients
        grid = self._grids(self._prepared_grid, solution.modes)
        half_width_m = bench_field.half_width_m
        gathered = bench_field.collimator_focal_length_m / self._reconstructor.sensor.wavenumber_rad_per_m

        def field(x_m: float, y_m: float) -> NDArray[np.complex64]:
            x, y = x_m / half_width_m, y_m / half_width_m
            wave = np.exp(1j * grid(coefficients @ modes.values(x, y)))
            if not bench_field.neglect_propagation:
                slopes = coefficients @ modes.gradients(x, y) * (gathered / half_width_m)  # (pupil_mode, xy)
                (xu, xv), (yu, yv) = (grid.gradients(along) for along in slopes.T)
                wave *= np.sqrt(np.maximum((1 + xu) * (1 + yv) - xv * yu, 0.0))
            return np.asarray(wave, np.complex64)

        return field


def _known(displacement: Displacement, *biases: Bias) -> Booleans:
    """Lenslets whose measured and modelled displacements are all known, (lenslet_row, lenslet_column)."""
    known = displacement.valid
    for bias in biases:
        known = known & np.isfinite(bias.modelled).all(axis=(2, 3))
    return known


def _misfit_px(displacement: Displacement, bias: Bias, lenslets: Booleans) -> float:
    """RMS difference of measured and modelled displacements over some lenslets; infinite over none."""
    misfit = (displacement.coefficients - bias.modelled)[lenslets]
    return float(np.sqrt(np.mean(misfit**2))) if misfit.size else np.inf
