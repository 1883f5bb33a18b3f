"""Refinement: what the geometric picture gets wrong, found by a forward model and taken away (defect correction).

A frame is simulated from the estimated wavefront and registered against the model's own reference, in the same way as
the camera's frame. By how much the displacements that come out differ from the mean gradients that went in is the
bias of the estimator at this wavefront. It is taken from the measured displacements, and the wavefront estimated
anew. Because only a difference is used, the model may be coarse; it is given, and not known here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from reconstruction.arrays import Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.pupil_modes import PupilGrid, pupil_modes
from reconstruction.pipeline import Reconstructor
from reconstruction.solve.modal import ModalSolver
from reconstruction.wavefront import Wavefront, rms

PointPhase: TypeAlias = Callable[[float, float], Image]

_IMPROVES = 0.6  # a round that changes the wavefront by more than this part of what the one before did ends it
_SETTLED_RAD = 1e-3  # a change that nobody sees


class ImagingModel(Protocol):
    """A forward model of the bench: the images that its camera would take."""

    sample_x_m: Floats  # pupil positions at which a phase is asked for: all combinations of these ...
    sample_y_m: Floats  # ... and these

    def image(self, phase: PointPhase | None) -> Image:
        """Image (row, column) of the source behind `phase`, or the reference.

        phase(x_m, y_m) is that of the object point (x, y) at the pupil samples, (sample_y, sample_x), rad.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Bias:
    """What the estimator gets wrong at one wavefront."""

    displacement: Floats  # measured minus true, px, (lenslet_row, lenslet_column, field_mode, xy)
    views: Floats  # that wavefront, rad, (view_row, view_column, lenslet_row, lenslet_column)


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """One round of refinement."""

    wavefront: Wavefront
    bias: Bias
    change_rad: float  # mean over the views of the RMS by which the round changed the wavefront


class Refinement:
    """Refines the wavefronts of one reconstructor with the model of its bench, whose reference is prepared once."""

    def __init__(self, reconstructor: Reconstructor, model: ImagingModel) -> None:
        self._reconstructor, self._model = reconstructor, model
        reference = model.image(None)
        self._register = reconstructor.against(reference)
        self._unsaturated = np.zeros(reference.shape, np.bool_)
        modes = pupil_modes(reconstructor.sensor, "legendre", None)
        self._gradients = modes.gradients  # (pupil_mode, lenslet_row, lenslet_column, xy), 1/m
        self._fit = ModalSolver(
            modes, reconstructor.whitening, is_smooth=True
        )  # the model wants phases between the lenslets, zonal or modal
        self._phase_at = PupilGrid(modes, reconstructor.sensor, model.sample_x_m, model.sample_y_m)

    def bias(self, wavefront: Wavefront) -> Bias:
        """Find the bias at a wavefront: one image of the model and its registration."""
        displacement, per_px = wavefront.displacement, self._reconstructor.sensor.slope_per_px
        coefficients = self._fit(
            displacement.coefficients * per_px,
            displacement.covariance * per_px**2,
            displacement.valid,
            weights=self._reconstructor.weights_of(displacement),
        ).coefficients
        image = self._model.image(self._phase(coefficients, displacement.modes))
        found = self._register(image, saturated=self._unsaturated)
        true_px = np.einsum("prcx,pq->rcqx", self._gradients, coefficients, optimize=True) / per_px
        # A lenslet that the model's image loses keeps what was measured.
        return Bias(np.where(found.valid[..., None, None], found.coefficients - true_px, 0.0), wavefront.views)

    def rounds(self, displacement: Displacement, most: int) -> Iterator[Round]:
        """Refine displacements in at most so many rounds; fewer, when they no longer improve."""
        wavefront, before_rad = self._reconstructor.solve(displacement), np.inf
        for _ in range(most):
            bias = self.bias(wavefront)
            refined = self._reconstructor.solve(displacement, bias=bias.displacement)
            change_rad = distance_rad(refined.views, wavefront.views)
            if change_rad > _IMPROVES * before_rad:
                return
            yield Round(refined, bias, change_rad)
            if change_rad < _SETTLED_RAD:
                return
            wavefront, before_rad = refined, change_rad

    def _phase(self, coefficients: Floats, modes: FieldModes) -> PointPhase:
        half_width_m = self._reconstructor.field.half_width_m

        def phase(x_m: float, y_m: float) -> Image:
            return self._phase_at(coefficients @ modes.values(x_m / half_width_m, y_m / half_width_m))

        return phase


def distance_rad(one: Floats, other: Floats) -> float:
    """Mean over the views of the RMS difference of two wavefronts (view_row, view_column, row, column), rad."""
    return mean_rms(one - other)


def mean_rms(views: Floats) -> float:
    """Mean over the known views of their RMS (view_row, view_column, row, column), rad; NaN when none is known."""
    each = rms(views)
    known = np.isfinite(each)
    return float(np.mean(each[known])) if known.any() else np.nan
