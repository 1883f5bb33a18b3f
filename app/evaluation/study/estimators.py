"""Estimators under study, prepared for one reference of one bench, and the wavefront from the true slopes of the light.

The residual of the true slopes shows what the field and pupil modes cannot represent, and what the mask hides; any
excess of an estimator comes from registration.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.studies import CaseResult, Position
from app.measurement.calibration import Calibration
from app.measurement.estimator import Estimator
from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Displacement, Outcome
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.pipeline import Reconstructor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, Warp
from reconstruction.wavefront import Wavefront, mean_rms
from simulated_devices.sample import Sample

ROUNDS = 3  # of refinement
WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic", "quartic")
REFINED: tuple[Warp, ...] = ("quadratic", "cubic", "quartic")
AUTOMATIC = ReconstructionSettings()  # modal, the number of modes chosen from the lattice
_FIELD_NODES, _LENSLET_NODES = 7, 6  # of Gauss-Legendre quadrature along each axis


class WarpEstimator(Estimator):
    """One warp with one reconstruction, and its refinement."""

    def __init__(
        self,
        bench: Bench,
        reference: Image,
        warp: Warp | None,
        *,
        reconstruction: ReconstructionSettings = AUTOMATIC,
        noise: CameraNoise | None = None,
    ) -> None:
        """Take a reference (row, column) above the dark, in the unit of the frames."""
        method = replace(bench, registration=RegistrationSettings(warp=warp), reconstruction=reconstruction)
        lattice, dark = bench.design_lattice(*reference.shape), np.zeros_like(reference)
        given = Calibration.of_images(method, reference, dark=dark, lattice=lattice)
        super().__init__(replace(given, known=KnownNoise(noise)))

    @cached_property
    def by_gradients(self) -> Reconstructor:
        """Reconstruction from mean gradients, without the response of the registration."""
        bench = self.calibration.bench
        settings = replace(bench.reconstruction, response=False)
        return replace(self.calibration, bench=replace(bench, reconstruction=settings)).reconstructor()

    def rounds(
        self, displacement: Displacement, most: int = ROUNDS, sample: AssumedSample = FREE
    ) -> list[tuple[Wavefront, float]]:
        """Return the wavefront after each round of refinement and its seconds; early ends repeat the last wavefront."""
        results, refinement = [(self.reconstructor.solve(displacement, sample=sample), math.nan)], self.refinement
        start_s = time.perf_counter()
        for step in refinement.rounds(displacement, most, sample):
            end_s = time.perf_counter()
            results.append((step.wavefront, end_s - start_s))
            start_s = end_s
        return results[1:] + [(results[-1][0], math.nan)] * (most + 1 - len(results))


class WarpEstimators:
    """Estimators of most sweeps: each warp in one pass, some of them with the layers found, and then refined."""

    def __init__(
        self,
        bench: Bench,
        reference: Image,
        *,
        noise: CameraNoise | None = None,
        warps: tuple[Warp, ...] = WARPS,
        refined: tuple[Warp, ...] = REFINED,
    ) -> None:
        self._refined = refined
        self.by_warp = {warp: WarpEstimator(bench, reference, warp, noise=noise) for warp in warps}

    def compare(
        self,
        frame: Image,
        truth: Floats,
        at: Position,
        *,
        prefix: str = "",
        views: NDArray[np.bool_] | None = None,
        sample: Sample | None = None,
    ) -> Iterator[CaseResult]:
        """Compare every estimator's wavefront of a frame (row, column) with the truth, see `compared`.

        With a `sample`, also compare the wavefront from the true slopes of its light.
        """
        for warp, estimator in self.by_warp.items():
            curve = prefix + warp
            try:
                displacement = estimator.reconstructor.register(frame)
                wavefront = estimator.reconstructor.solve(displacement)
                yield compared(curve, at, wavefront, truth, views=views)
                if sample is not None:
                    wavefront = exact_wavefront(sample, estimator.by_gradients, displacement)
                    yield compared(f"{curve}, true slopes", at, wavefront, truth, views=views)
                if warp in self._refined:
                    found = estimator.reconstructor.find_sample(displacement)
                    wavefront = estimator.reconstructor.solve(displacement, sample=found)
                    yield compared(f"{curve} layers", at, wavefront, truth, views=views)
                    curve += " refined"
                    wavefront, _ = estimator.solve(displacement, sample=found, rounds=ROUNDS)
                    yield compared(curve, at, wavefront, truth, views=views)
            except ReconstructionError:
                lenslets = estimator.reconstructor.sensor.lenslet_rows * estimator.reconstructor.sensor.lenslet_columns
                values = {"rms_rad": math.nan, "lost": lenslets, "left_cell": 0, "seconds": math.nan}
                yield CaseResult(at={"curve": curve, "at": at}, values=values)


def compared(
    curve: str,
    at: Position,
    wavefront: Wavefront,
    truth: Floats,
    *,
    views: NDArray[np.bool_] | None = None,
    lenslets: Booleans | None = None,
    **more: float,
) -> CaseResult:
    """Compare a wavefront with the truth (view_row, view_column, lenslet_row, lenslet_column), rad; see `with_rms`.

    Without `views` (view_row, view_column) all of them count, without `lenslets` the valid ones.
    """
    lenslets = wavefront.displacement.valid if lenslets is None else lenslets
    return with_rms(curve, at, wavefront, mean_rms_within(wavefront.views - truth, lenslets, views), **more)


def with_rms(curve: str, at: Position, wavefront: Wavefront, rms_rad: float, **more: float) -> CaseResult:
    """Return an RMS with the counts of lost lenslets of a wavefront.

    More are `seconds`; `asked_rad`, a limit of its own; and `coverage`, the share of lenslets within the error bar
    `rms_rad`.
    """
    outcome = wavefront.displacement.outcome
    lost, left_cell = np.sum(outcome != Outcome.CONVERGED), np.sum(outcome == Outcome.LEFT_CELL)
    values = {"rms_rad": rms_rad, "lost": float(lost), "left_cell": float(left_cell)}
    unknown = dict.fromkeys(("seconds", "asked_rad", "coverage"), math.nan)
    return CaseResult(at={"curve": curve, "at": at}, values=values | unknown | more)


def mean_rms_within(difference: Floats, lenslets: Booleans, views: NDArray[np.bool_] | None = None) -> float:
    """Mean over the views of the RMS over the lenslets without piston; NaN if no view is known.

    `difference` (view_row, view_column, lenslet_row, lenslet_column), rad; `lenslets` and `views` that count.
    """
    counted = np.where(lenslets, difference, np.nan)
    return mean_rms(counted if views is None else counted[views])


def exact_wavefront(sample: Sample, reconstructor: Reconstructor, displacement: Displacement) -> Wavefront:
    """Solve for the true displacements of the frame that was registered as `displacement`."""
    nodes, weights = np.polynomial.legendre.leggauss(_FIELD_NODES)
    modes = displacement.modes.values(nodes, nodes[:, None])  # (field_mode, node_y, node_x)
    square = np.einsum("qyx,qyx,y,x->q", modes, modes, weights, weights)
    half_width_m = reconstructor.field.half_width_m
    coefficients = np.zeros_like(displacement.coefficients)
    for row, y in enumerate(nodes):
        for column, x in enumerate(nodes):
            slopes = _mean_slopes(sample, reconstructor, x * half_width_m, y * half_width_m)
            share = modes[:, row, column] * weights[row] * weights[column] / square
            coefficients += share[:, None] * slopes[:, :, None]
    return reconstructor.solve(replace(displacement, coefficients=coefficients / reconstructor.sensor.slope_per_px))


def _mean_slopes(sample: Sample, reconstructor: Reconstructor, x_m: float, y_m: float) -> Floats:
    """Mean slope over each lenslet for the object point (x, y): (lenslet_row, lenslet_column, xy), rad/m."""
    sensor, rays = reconstructor.sensor, sample.light.ray_map
    half_m = sensor.lenslet_pitch_m / 2
    nodes, weights = np.polynomial.legendre.leggauss(_LENSLET_NODES)
    along_m, across_m = np.array([-half_m, half_m]), nodes * half_m

    def at(u_m: Floats, v_m: Floats) -> Floats:
        """Phase at pupil positions u, v from each lenslet's centre: (u, v, lenslet_row, lenslet_column)."""
        s_m = rays.pupil_scale * (sensor.pupil_x_m + u_m[:, None, None, None]) + rays.field_scale * x_m
        t_m = rays.pupil_scale * (sensor.pupil_y_m[:, None] + v_m[None, :, None, None]) + rays.field_scale * y_m
        return sample.light.phase.at(s_m, t_m)

    x_slopes = np.tensordot(weights / 2, np.diff(at(along_m, across_m), axis=0)[0], axes=1)
    y_slopes = np.tensordot(weights / 2, np.diff(at(across_m, along_m), axis=1)[:, 0], axes=1)
    return np.stack([x_slopes, y_slopes], axis=-1) / sensor.lenslet_pitch_m
