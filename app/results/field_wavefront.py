"""The wavefront at any field position, from a file of results or from a recording; the mean over its frames."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from app.bench.config import Bench
from app.errors import SETTINGS_CHANGED, InputError
from app.progress import Progress
from app.recording.reader import Recording, selected
from app.recording.reprocess import reprocess
from app.results.dataset import reading_results
from app.results.single_frame import require_plausible
from reconstruction.arrays import Floats
from reconstruction.deconvolution.corrected_image import PhaseAt
from reconstruction.modes.field_modes import LegendreModes, ZernikeModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.wavefront import without_piston

_Frame = tuple[Floats | None, Floats]  # e_pq (pupil_mode, field_mode), and the wavefronts of the views, rad


def mean_wavefront(source: Path, bench: Bench, frames: str | None, progress: Progress) -> PhaseAt:
    """Return the mean wavefront of the frames FIRST:END of results or of a recording.

    Modal results hold it for every position of the field. Others are interpolated between their views, by splines of
    the third degree if there are at least four along a side.

    Raises
    ------
    InputError
        If the source cannot be read, or has neither coefficients nor several views.
    """
    read = _of_recording if source.is_dir() else _of_results
    coefficients: Floats | None = None
    views, count = np.zeros(()), 0
    for of_frame, views_of_frame in read(source, frames, progress):
        if count and (views_of_frame.shape != views.shape or _shape(of_frame) != _shape(coefficients)):
            raise InputError(f"{source}: {SETTINGS_CHANGED}")
        views, count = views + views_of_frame, count + 1
        coefficients = of_frame if coefficients is None or of_frame is None else coefficients + of_frame
    if not count:
        raise InputError(f"{source}: has no frame with a wavefront")
    if coefficients is not None and bench.registration.method == "gauss_newton":
        return _of_modes(bench, coefficients / count, views / count)
    return _between_views(source, bench, views / count)


def _shape(values: Floats | None) -> tuple[int, ...]:
    return () if values is None else values.shape


def _of_results(source: Path, frames: str | None, progress: Progress) -> Iterator[_Frame]:
    with reading_results(source) as results:
        stacked = results if "frame" in results.dims else results.expand_dims("frame")
        chosen = selected(frames, stacked.sizes["frame"], source)
        for done, index in enumerate(chosen, 1):
            frame = stacked.isel(frame=index)
            coefficients = frame["coefficients"].values if "coefficients" in frame else None
            if coefficients is not None:
                require_plausible(source, coefficients)
            yield coefficients, frame["wavefront"].values
            progress("reading wavefronts", done / len(chosen))


def _of_recording(source: Path, frames: str | None, progress: Progress) -> Iterator[_Frame]:
    recording = Recording(source)
    chosen = recording.select(frames)
    for done, frame in enumerate(reprocess(recording, chosen), 1):
        if frame.wavefront is not None:
            yield frame.wavefront.coefficients, frame.wavefront.views
        progress("reconstructing frames", done / len(chosen))


def _of_modes(bench: Bench, coefficients: Floats, views: Floats) -> PhaseAt:
    """Evaluate e_pq; lenslets that are unknown at every view stay unknown."""
    modes = (ZernikeModes if bench.field.shape == "circle" else LegendreModes)(coefficients.shape[1])
    values = pupil_modes(bench.sensor, bench.reconstruction.basis, len(coefficients)).values
    known, half_m = np.isfinite(views).any(axis=(0, 1)), bench.field.half_width_m

    def phase_at(x_m: float, y_m: float) -> Floats:
        phase = np.tensordot(coefficients @ modes.values(x_m / half_m, y_m / half_m), values, axes=1)
        return without_piston(np.where(known, phase, np.nan))

    return phase_at


def _between_views(source: Path, bench: Bench, views: Floats) -> PhaseAt:
    field = bench.field
    if min(views.shape[:2]) < 2:
        raise InputError(
            f"{source}: holds neither coefficients nor several views along both axes, so that the wavefront between"
            " them is unknown: reconstruct with the modal method"
        )
    if not np.isfinite(views).all(axis=(0, 1)).any():
        raise InputError(f"{source}: no lenslet is known at every view: reconstruct with the modal method")
    along_y, along_x = (
        make_interp_spline(at_m, np.eye(len(at_m)), k=min(3, len(at_m) - 1))
        for at_m in (field.view_y_m, field.view_x_m)
    )

    def phase_at(x_m: float, y_m: float) -> Floats:
        return np.asarray(np.einsum("v,w,vwrc->rc", along_y(y_m), along_x(x_m), views))

    return phase_at
