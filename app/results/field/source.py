"""Coefficients e_pq of one frame, from a recording or a results file."""

from pathlib import Path

import numpy as np

from app.bench.config import Bench
from app.errors import InputError
from app.results.single_frame import recorded_frame, stored_frame
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import ModalFit
from reconstruction.modes.field_modes import LegendreModes, ZernikeModes
from reconstruction.modes.pupil_modes import pupil_modes


def read_fit(source: Path, frame: int) -> tuple[Bench, ModalFit]:
    """Return bench and coefficients of one frame, counted from 0, of a recording or a results file.

    A results file has the standard deviations of e_pq without their covariance: they are taken as uncorrelated. Raises
    `InputError` if there is no such frame, or it has no coefficients.
    """
    return _of_recording(source, frame) if source.is_dir() else _of_results(source, frame)


def _of_recording(folder: Path, frame: int) -> tuple[Bench, ModalFit]:
    calibration, wavefront = recorded_frame(folder, frame)
    try:
        return calibration.bench, ModalFit.of(wavefront)
    except ReconstructionError as error:
        raise InputError(f"{folder}: {error}") from error


def _of_results(path: Path, frame: int) -> tuple[Bench, ModalFit]:
    bench, results = stored_frame(path, frame, "coefficients_sigma", "wavefront")
    rad, sigma = (
        results[name].transpose("pupil_mode", "field_mode").values for name in ("coefficients", "coefficients_sigma")
    )
    views = results["wavefront"].transpose("view_row", "view_column", ...).values
    if bench.registration.method != "gauss_newton":
        raise InputError(f"{path}: its wavefront is known at its views alone: reconstruct with method gauss_newton")
    modes = pupil_modes(bench.sensor, bench.reconstruction.basis, len(rad))
    field_modes = (ZernikeModes if bench.field.shape == "circle" else LegendreModes)(rad.shape[1])
    uncorrelated = np.diag(sigma[1:].ravel()).reshape(*sigma[1:].shape, -1)
    known = np.isfinite(views).any(axis=(0, 1))
    return bench, ModalFit(bench.sensor, modes, field_modes, rad, uncorrelated, known)
