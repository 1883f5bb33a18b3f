"""Bench, wavefronts and coefficients from a recording or a file of results."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy  # which loads its parts when they are used

from app.bench.bench_files import written_by
from app.bench.config import Bench, parse_bench
from app.errors import SETTINGS_CHANGED, InputError
from app.progress import Progress
from app.results.result_file import reading_results
from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement, LensletStatus, diagonal_covariance
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layer_solver import FrameEquations, LayerSolver
from reconstruction.modes.field_modes import PolynomialModes, SampledModes, gradient_basis, orthogonal_modes
from reconstruction.modes.layered_modes import layered_wavefronts
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes
from reconstruction.solve.expected_errors import MeanGradients
from reconstruction.solve.modal import ModalSolver
from reconstruction.wavefront import Wavefront, without_piston

if TYPE_CHECKING:
    import xarray as xr

    from app.measurement.calibration import Calibration
    from app.recording.reprocess import Change
    from reconstruction.deconvolution.corrected_image import PhaseAt
    from reconstruction.field_coefficients import ModalFit

_NOT_MEASURED = (
    "holds wavefronts that were not measured, such as the truth of a simulation: give a recording, or a file that svwfs"
    " reconstruct, measure or replay wrote"
)
_SAME_RAD = 1e-3  # beyond rounding
_LARGEST_RAD = 1e6  # of a coefficient: displacements of thousands of pixels


def recorded_frame(folder: Path, frame: int) -> tuple[Calibration, Wavefront]:
    """Reconstruct one frame of a recording, from 0; `InputError` if it is missing or has no wavefront."""
    from app.recording.reader import Recording
    from app.recording.reprocess import reprocess

    recording = Recording(folder)
    _require_frame(folder, frame, len(recording))
    (made,) = reprocess(recording, [frame])
    if made.wavefront is None or made.calibration is None:
        raise InputError(f"{folder}: frame {frame} has no wavefront: {made.problem}")
    return made.calibration, made.wavefront


def stored_frame(path: Path, frame: int, *names: str) -> tuple[Bench, xr.Dataset]:
    """Return bench, variables and modal coefficients of a frame, from 0, of a results file; `InputError` if missing."""
    with reading_results(path) as opened:
        if "displacement" not in opened:
            raise InputError(f"{path}: {_NOT_MEASURED}")
        if missing := [name for name in names if name not in opened]:
            raise InputError(f"{path}: is damaged: it lacks {', '.join(missing)}")
        results = opened[[*names, *({"coefficients", "coefficients_sigma"} & {*map(str, opened)})]]
        results = results if "frame" in results.dims else results.expand_dims("frame")
        _require_frame(path, frame, results.sizes["frame"])
        bench = parse_bench(str(opened.attrs.get("bench", "")), f"{path}: bench")
        one = results.isel(frame=frame).load()
    if "coefficients" in one:
        _require_plausible(path, one["coefficients"].values)
        if (one["coefficients_sigma"].values < 0).any():
            raise InputError(f"{path}: is damaged: it has an error bar below 0")
    return bench, one


def _require_plausible(path: Path, coefficients: Floats) -> None:
    """Raise `InputError` unless a measurement can have given coefficients e_pq, rad, of any shape."""
    if not (np.abs(coefficients) < _LARGEST_RAD).all():  # nor is NaN
        worst = np.max(np.abs(coefficients))
        raise InputError(f"{path}: is damaged: it has a coefficient of {worst:g} rad, which no wavefront has")


def _require_frame(source: Path, frame: int, count: int) -> None:
    if not 0 <= frame < count:
        raise InputError(f"{source}: there is no frame {frame}; frames are counted from 0, their number is {count}")


def read_bench_of(source: Path, settings: tuple[str, ...] = ()) -> Bench:
    """Return the bench of results or of a recording, changed by "section.key=value"."""
    if source.is_dir():
        from app.recording.folder import read_run, version_of

        run = read_run(source)
        text, software = str(run["bench"]), version_of(run)
    else:
        with reading_results(source) as results:
            text, software = (str(results.attrs.get(name, "")) for name in ("bench", "software"))
    with written_by(source, software):
        return parse_bench(text, f"{source}: bench", settings)


def removed_from(source: Path) -> str:
    """Return the names of the modes that `svwfs reconstruct --remove` left out of results, or ""."""
    if source.is_dir():
        return ""
    with reading_results(source) as results:
        removed = str(results.attrs.get("removed", "nothing"))
    return "" if removed == "nothing" else removed


def read_fit(source: Path, frame: int) -> tuple[Bench, ModalFit]:
    """Return bench and coefficients of one frame, counted from 0, of a recording or a results file.

    A results file has the standard deviations of e_pq without their covariance: they are taken as uncorrelated. To
    zonal wavefronts, and between stars, Zernike modes are fitted at the views. `InputError` if there is no such frame.
    """
    from reconstruction.field_coefficients import ModalFit

    if source.is_dir():
        calibration, wavefront = recorded_frame(source, frame)
        return calibration.bench, ModalFit.of(wavefront)
    bench, results = stored_frame(source, frame, "wavefront")
    views = results["wavefront"].transpose("view_row", "view_column", ...).values
    if "coefficients" in results:
        names = ("coefficients", "coefficients_sigma")
        rad, sigma = (results[name].transpose("pupil_mode", "field_mode").values for name in names)
        if (modes := modes_at_views(bench, rad, views)) is not None:
            uncorrelated = np.diag(sigma[1:].ravel()).reshape(*sigma[1:].shape, -1)
            known = np.isfinite(views).any(axis=(0, 1))
            return bench, ModalFit(bench.sensor, *modes, rad, uncorrelated, known)
    field = bench.field
    if not np.isfinite(views).any(axis=(2, 3)).all():
        raise InputError(f"{source}: the wavefront between its views is unknown: reconstruct with the modal method")
    between = SampledModes(field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m)
    return bench, ModalFit.fitted(bench.sensor, between, views.reshape(-1, *views.shape[2:]))


def modes_at_views(bench: Bench, coefficients: Floats, views: Floats) -> tuple[PupilModes, PolynomialModes] | None:
    """Return the modes of the views' coefficients e_pq, rad; None for stars, other bases and removed modes."""
    try:
        pupil, modes = modes_of(bench, coefficients)
    except ReconstructionError:  # an own basis
        return None
    field = bench.field
    x, y = field.view_x_m / field.half_width_m, field.view_y_m[:, None] / field.half_width_m
    phase = np.tensordot(np.moveaxis(modes.values(x, y), 0, -1) @ coefficients.T, pupil.values, axes=1)
    apart_rad = without_piston(np.where(np.isfinite(views), phase, np.nan)) - without_piston(views)
    return (pupil, modes) if np.nanmax(np.abs(apart_rad), initial=0) < _SAME_RAD else None


def modes_of(bench: Bench, coefficients: Floats) -> tuple[PupilModes, PolynomialModes]:
    """Return the pupil modes and field modes of coefficients e_pq of a bench, (pupil_mode, field_mode)."""
    pupil, field = coefficients.shape
    field_modes = orthogonal_modes(bench.field, field)
    return pupil_modes(bench.sensor, bench.reconstruction.basis, pupil), field_modes


_Frame = tuple[Floats, Floats]  # e_pq (pupil_mode, field_mode), empty without any, and the wavefronts of the views, rad


def mean_wavefront(source: Path, bench: Bench, frames: str | None, progress: Progress) -> PhaseAt:
    """Return the mean wavefront of the frames FIRST:END of results or of a recording, for every position of the field.

    Results that are not modal are interpolated between their views, by cubic splines if four or more lie along a side.
    `InputError` if the source cannot be read, or has neither coefficients nor several views.
    """
    coefficients, views = mean_of_frames(source, frames, progress)
    if coefficients.size and modes_at_views(bench, coefficients, views) is not None:
        return _of_modes(bench, coefficients, views)
    return _between_views(source, bench, views)


def mean_of_frames(
    source: Path, frames: str | None = None, progress: Progress = lambda *_: None, change: Change | None = None
) -> _Frame:
    """Return the mean of frames, of a recording also after a change; `InputError` if they do not go together."""
    if change is not None and not source.is_dir():
        raise InputError(f"{source}: settings can be changed for recordings alone, which are reconstructed again")
    read = partial(_recorded_frames, change=change) if source.is_dir() else _stored_frames
    coefficients, views, count = np.zeros(()), np.zeros(()), 0
    for of_frame, views_of_frame in read(source, frames, progress):
        if count and (views_of_frame.shape != views.shape or of_frame.shape != coefficients.shape):
            raise InputError(f"{source}: {SETTINGS_CHANGED}")
        coefficients, views, count = coefficients + of_frame, views + views_of_frame, count + 1
    if not count:
        raise InputError(f"{source}: has no frame with a wavefront")
    return coefficients / count, views / count


def _stored_frames(source: Path, frames: str | None, progress: Progress) -> Iterator[_Frame]:
    from app.recording.reader import selected

    with reading_results(source) as results:
        stacked = results if "frame" in results.dims else results.expand_dims("frame")
        chosen = selected(frames, stacked.sizes["frame"], source)
        for done, index in enumerate(chosen, 1):
            frame = stacked.isel(frame=index)
            coefficients = np.zeros(0)
            if "coefficients" in frame:
                coefficients = frame["coefficients"].transpose("pupil_mode", "field_mode").values
            _require_plausible(source, coefficients)
            yield coefficients, frame["wavefront"].transpose("view_row", "view_column", ...).values
            progress("reading wavefronts", done / len(chosen))


def _recorded_frames(source: Path, frames: str | None, progress: Progress, change: Change | None) -> Iterator[_Frame]:
    from app.recording.reader import Recording
    from app.recording.reprocess import reprocess

    recording = Recording(source)
    chosen = recording.select(frames)
    for done, frame in enumerate(reprocess(recording, chosen, change), 1):
        if frame.wavefront is not None:
            coefficients = frame.wavefront.coefficients
            yield np.zeros(0) if coefficients is None else coefficients, frame.wavefront.views
        progress("reconstructing frames", done / len(chosen))


def _of_modes(bench: Bench, coefficients: Floats, views: Floats) -> PhaseAt:
    """Evaluate e_pq, rad, (p, q); lenslets that are unknown in all `views` stay unknown."""
    pupil, modes = modes_of(bench, coefficients)
    known, half_m = np.isfinite(views).any(axis=(0, 1)), bench.field.half_width_m

    def phase_at(x_m: float, y_m: float) -> Floats:
        phase = np.tensordot(coefficients @ modes.values(x_m / half_m, y_m / half_m), pupil.values, axes=1)
        return without_piston(np.where(known, phase, np.nan))

    return phase_at


def _between_views(source: Path, bench: Bench, views: Floats) -> PhaseAt:
    """Interpolate wavefronts, rad, (view_row, view_column, lenslet_row, lenslet_column)."""
    field = bench.field
    if min(views.shape[:2]) < 2:
        raise InputError(
            f"{source}: holds neither coefficients nor several views along both axes, so that the wavefront between"
            " them is unknown: reconstruct with the modal method"
        )
    if not np.isfinite(views).all(axis=(0, 1)).any():
        raise InputError(f"{source}: no lenslet is known at every view: reconstruct with the modal method")
    along_y, along_x = (
        scipy.interpolate.make_interp_spline(at_m, np.eye(len(at_m)), k=min(3, len(at_m) - 1))
        for at_m in (field.view_y_m, field.view_x_m)
    )

    def phase_at(x_m: float, y_m: float) -> Floats:
        return np.asarray(np.einsum("v,w,vwrc->rc", along_y(y_m), along_x(x_m), views))

    return phase_at


def phase_of(source: Wavefront | str | Path, bench: Bench) -> PhaseAt:
    """Return the wavefront at any field position, of a wavefront, a file of results or a recording."""
    if isinstance(source, str | Path):
        return mean_wavefront(Path(source), bench, None, lambda *_: None)
    return measured(source).at


def measured(wavefront: object) -> Wavefront:
    """Refuse anything but a wavefront."""
    if not isinstance(wavefront, Wavefront):
        raise InputError(f"a wavefront is needed, not {type(wavefront).__name__}; Measurement.problem says why")
    return wavefront


_ROUNDING = 1e-6  # singular value over the largest, below which displacements are zero


def measured_frame(source: Path, frame: int) -> tuple[Bench, FrameEquations]:
    """Bench and equations of a frame, from 0; `InputError` if missing, `ReconstructionError` if it shows no layers."""
    if source.is_dir():
        calibration, wavefront = recorded_frame(source, frame)
        return calibration.bench, calibration.reconstructor().layers(wavefront.displacement)
    bench, results = stored_frame(source, frame, "displacement", "displacement_sigma", "valid")
    if "coefficients" not in results:
        raise InputError(f"{source}: holds no coefficients: reconstruct with reconstruction.method=modal")
    sigma_px = results["displacement_sigma"].values[results["valid"].values.astype(bool)]
    if not ((sigma_px > 0) & np.isfinite(sigma_px)).all():
        raise InputError(f"{source}: is damaged: the error of a displacement must be above 0 px and finite")
    return bench, _equations(results, bench)


def _equations(results: xr.Dataset, bench: Bench) -> FrameEquations:
    """Equations of the mean slopes of the modal wavefront, which no longer have the registration's bias."""
    sensor, coefficients = bench.sensor, results["coefficients"].values
    basis, modes = modes_of(bench, coefficients)
    gradients = gradient_basis(modes)
    parameters = _shown(results, gradients)
    sensitivity = MeanGradients(sensor, parameters)
    of_lenslets = np.einsum("lkpq,pq->lk", sensitivity(basis, slice(None)), coefficients[1:]) @ parameters
    shape = sensor.lenslets
    variance = diagonal_covariance(results["displacement_sigma"].values ** 2)
    unknown, valid = np.full(shape, np.nan), results["valid"].values.astype(bool)
    displacement = Displacement(
        modes=modes,
        coefficients=np.swapaxes(of_lenslets.reshape(*shape, 2, -1), 2, 3),
        covariance_source=variance,
        outcome=np.where(valid & basis.inside, LensletStatus.CONVERGED, LensletStatus.DARK),
        residual_rms=unknown,
        chi_square=unknown,
        range_used=unknown,
    )
    smooth = pupil_modes(sensor, "legendre", None)
    layered = layered_wavefronts(sensor, smooth, modes, parameters)
    free = ModalSolver(smooth, sensitivity, parameters, variance, layered=layered, field_degree=modes.degree)
    solver = LayerSolver(sensor, bench.field, modes, free, hidden=len(gradients) - len(parameters))
    return FrameEquations(solver, displacement)


def _shown(results: xr.Dataset, gradients: Floats) -> Floats:
    """Displacements without rotation that were determined, orthonormal rows (K, x then y modes).

    `gradients` has all of them; in what the mask hides, every lenslet's displacement is zero.
    """
    valid = results["valid"].values.astype(bool)
    vectors = np.swapaxes(results["displacement"].values[valid], 1, 2).reshape(np.count_nonzero(valid), -1)
    _, singular, components = np.linalg.svd(vectors @ gradients.T, full_matrices=False)
    moves = singular > _ROUNDING * np.max(singular, initial=0.0)
    if not moves.any():
        raise ReconstructionError("no lenslet is displaced: there is no layer to find")
    return np.asarray(components[moves] @ gradients)
