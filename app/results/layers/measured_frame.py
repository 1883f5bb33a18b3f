"""Normal equations of a measured frame, from a recording or a results file."""

from pathlib import Path

import numpy as np
import xarray as xr

from app.bench.config import Bench
from app.errors import InputError
from app.results.single_frame import recorded_frame, stored_frame
from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement, Outcome, diagonal_covariance
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layer_solver import FrameEquations, LayerSolver
from reconstruction.modes.field_modes import LegendreModes, PolynomialModes, ZernikeModes, gradient_basis
from reconstruction.modes.layered_modes import layered_wavefronts
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.solve.modal import ModalSolver
from reconstruction.solve.sensitivity import MeanGradients

_ROUNDING = 1e-6  # singular value over the largest, below which displacements are zero


def measured_frame(source: Path, frame: int) -> tuple[Bench, FrameEquations]:
    """Return bench and equations of one frame, counted from 0, of a recording or a results file.

    Raises `InputError` if there is no such frame, or it cannot tell of layers.
    """
    try:
        return _of_recording(source, frame) if source.is_dir() else _of_result(source, frame)
    except ReconstructionError as error:
        raise InputError(f"{source}: {error}") from error


def _of_recording(folder: Path, frame: int) -> tuple[Bench, FrameEquations]:
    calibration, wavefront = recorded_frame(folder, frame)
    return calibration.bench, calibration.reconstructor().layers(wavefront.displacement)


def _of_result(path: Path, frame: int) -> tuple[Bench, FrameEquations]:
    """Equations of the mean slopes of the modal wavefront, which no longer have the registration's bias."""
    bench, results = stored_frame(path, frame, "displacement", "displacement_sigma", "valid")
    sigma_px = results["displacement_sigma"].values[results["valid"].values.astype(bool)]
    if not ((sigma_px > 0) & np.isfinite(sigma_px)).all():
        raise InputError(f"{path}: is damaged: the error of a displacement must be above 0 px and finite")
    return bench, _equations(results, bench)


def _equations(results: xr.Dataset, bench: Bench) -> FrameEquations:
    sensor, coefficients = bench.sensor, results["coefficients"].values
    modes: PolynomialModes = (ZernikeModes if bench.field.shape == "circle" else LegendreModes)(coefficients.shape[1])
    gradients = gradient_basis(modes)
    parameters = _shown(results, gradients)
    sensitivity = MeanGradients(sensor, parameters)
    basis = pupil_modes(sensor, bench.reconstruction.basis, len(coefficients))
    of_lenslets = np.einsum("lkpq,pq->lk", sensitivity(basis, slice(None)), coefficients[1:]) @ parameters
    shape = sensor.lenslet_rows, sensor.lenslet_columns
    variance = diagonal_covariance(results["displacement_sigma"].values ** 2)
    unknown = np.full(shape, np.nan)
    displacement = Displacement(
        modes=modes,
        coefficients=np.swapaxes(of_lenslets.reshape(*shape, 2, -1), 2, 3),
        covariance=variance,
        outcome=np.where(results["valid"].values.astype(bool) & basis.inside, Outcome.CONVERGED, Outcome.DARK),
        residual_rms=unknown,
        chi_square=unknown,
        range_used=unknown,
    )
    smooth = pupil_modes(sensor, "legendre", None)
    layered = layered_wavefronts(sensor, smooth, modes, parameters)
    free = ModalSolver(smooth, sensitivity, parameters, variance, layered=layered, field_degree=modes.degree)
    return LayerSolver(sensor, bench.field, modes, free, len(gradients) - len(parameters))(displacement)


def _shown(results: xr.Dataset, gradients: Floats) -> Floats:
    """Displacements without rotation that the registration determined, orthonormal rows (K, x modes and then y modes).

    `gradients` has all of them; in what the mask hides, every lenslet's displacement is zero.
    """
    valid = results["valid"].values.astype(bool)
    vectors = np.swapaxes(results["displacement"].values[valid], 1, 2).reshape(np.count_nonzero(valid), -1)
    _, singular, components = np.linalg.svd(vectors @ gradients.T, full_matrices=False)
    moves = singular > _ROUNDING * np.max(singular, initial=0.0)
    if not moves.any():
        raise ReconstructionError("no lenslet is displaced: there is no layer to find")
    return np.asarray(components[moves] @ gradients)
