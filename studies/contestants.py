"""Speed and accuracy next to other software: registration, zonal solve, and forward model.

All of them get the same frame above the same dark in the same 31 x 31 pixels per lenslet. They are timed from counts to
displacements only, ours to wavefronts and coefficients. Only pyrtcao processes a whole frame in one call.

* SimpleITK: the settings of MATLAB's imregtform; two threads share the lenslets.
* OpenCV: `findTransformECC` with an affine map and its default criteria (50 steps, 1e-3; tighter ones leave no smaller
  residual), started at the previous frame like ours; two threads share the lenslets, as its calls release the GIL. Also
  cold, and in one thread.
* scikit-image: `phase_cross_correlation` to a tenth of a pixel (finer leaves the same residual); the transforms of all
  subimages in one call, those of the reference in advance; no phase normalisation, which fails on squares.
* pyrtcao: `compute_slopes_shwfs_correlation_numba`, single-threaded. It searches up to the edge of the cell, like ours,
  and as a separate contestant only as far as these frames need.
* SciPy: `splu` of Southwell's equations for a lattice without lost lenslets.
* HCIPy: one object point, one sample per pixel; ours repeats its costs per image for a few points.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import fft, sparse
from scipy.sparse.linalg import splu

from app.evaluation.benchmark import TimedFrames, noise_free, noisy
from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.geometry import centered_steps
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.runtime.opencv import cv2
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, Warp
from reconstruction.solve.zonal import zonal_wavefront
from reconstruction.wavefront import Wavefront, rms
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.source import SourcePoints
from studies.tables import Asked, Made, Row

Register = Callable[[NDArray[Any]], Floats]
"""Takes counts (row, column), returns coefficients c_q of 1, x / h, y / h, px, (lenslet, xy, 1 or 3)."""

OURS = "quadratic, warm, 2 threads"
RATIOS = {  # times over ours that were once reached; they hardly depend on the computer
    "simpleitk_affine": 381.0,
    "opencv_ecc_affine": 6.71,
    "skimage_phase_correlation": 11.2,
    "pyrtc_correlation": 1.49,
}
_THREADS = 2
_TENTH = 10  # steps per pixel of the found shift
_ECC_STEPS, _ECC_TOLERANCE = 50, 1e-3  # defaults of findTransformECC
_NO_SEARCH_PX = 1.0
_NARROW_PX = 2  # reach of pyrtcao's correlation that suffices for these frames
_TURN_S = 0.02  # minimum duration of a turn; quicker calls are repeated
_LEAST_CALLS = 3
_WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic")
_POINTS = 8  # along a side
_BEND_RAD_PER_M2 = 3e5


def contestants(asked: Asked, budget_s: float = 1.5) -> Made:
    """Time and residual next to SimpleITK, OpenCV, scikit-image, pyrtcao, SciPy and HCIPy, each timed for `budget_s`.

    `over_ours` is the time over the time of svwfs at the same task, `before` that ratio when it was last recorded.
    """
    with one_blas_thread():  # as in the live path
        clean = noise_free(asked.bench)
        grainy = noisy(clean, np.random.default_rng(1))
        rows = [*_registrations(clean, grainy, budget_s), *_solves(grainy, budget_s), *_images(grainy, budget_s)]
    table = pd.DataFrame(rows)
    figure = Figure(figsize=(9, 0.3 * len(table) + 1), layout="constrained")
    panel = figure.subplots()
    panel.barh(table["task"] + ": " + table["by"], table["median_s"] * 1e3)
    panel.set(xscale="log", xlabel="median time (ms)")
    panel.invert_yaxis()
    return table, figure


def _timed(
    task: str, calls: Mapping[str, Callable[[], Any]], own: str, budget_s: float, own_count: int = 1
) -> list[Row]:
    """Time calls in turn, of which `own` does the task so many times; return a row for each."""
    seconds = {name: float(np.median(each)) for name, each in side_by_side(calls, budget_s).items()}
    seconds[own] /= own_count
    return [
        {"task": task, "by": name, "median_s": each, "over_ours": each / seconds[own]} for name, each in seconds.items()
    ]


def side_by_side(calls: Mapping[str, Callable[[], Any]], budget_s: float) -> dict[str, list[float]]:
    """Time calls in turn until each has had `budget_s` and three calls, so that other load slows all of them alike.

    Returns the seconds of each call by contestant; its first call may compile or load something and is not timed.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    waiting = dict(calls)
    while waiting:
        for name, call in list(waiting.items()):
            turn_s = 0.0
            while turn_s < _TURN_S:
                start_s = time.perf_counter()
                call()
                seconds[name].append(time.perf_counter() - start_s)
                turn_s += seconds[name][-1]
            if sum(seconds[name]) >= budget_s and len(seconds[name]) >= _LEAST_CALLS:
                del waiting[name]
    return seconds


def _registrations(clean: TimedFrames, grainy: TimedFrames, budget_s: float) -> Iterator[Row]:
    """Time every registration on the noisy frame; residuals, rad, of both by the same zonal solve."""
    calls: dict[str, Callable[[], Any]] = {}
    residuals: dict[str, dict[str, float]] = {}
    for kind, frames in (("noise_free", clean), ("noisy", grainy)):
        for name, call in _ours(frames):
            calls[name], found = call, coefficients_of(call().displacement)
            residuals.setdefault(name, {})[f"{kind}_rad"] = residual_rad(frames, found)
        for name, prepare in PEERS.items():
            if "problem" in residuals.setdefault(name, {}):
                continue
            try:
                register = prepare(frames)
                residuals[name][f"{kind}_rad"] = residual_rad(frames, register(frames.frame))
                calls[name] = partial(register, frames.frame)
            except Exception as error:  # noqa: BLE001 - any problem of a peer is reported
                residuals[name]["problem"] = f"{type(error).__name__}: {error}"  # type: ignore[assignment] # a column of its own
    for row in _timed("registration", calls, OURS, budget_s):
        yield {**row, "before": RATIOS.get(row["by"]), **residuals.pop(row["by"])}
    yield from ({"task": "registration", "by": name, **missing} for name, missing in residuals.items())


def _solves(frames: TimedFrames, budget_s: float) -> list[Row]:
    """Time the zonal solve of all views, next to bare equations of the same kind."""
    sensor = frames.bench.sensor
    coefficients = frames.reconstructor(RegistrationSettings(warp="quadratic")).register(frames.frame).coefficients
    slopes = _slopes(frames, np.nan_to_num(coefficients))
    slopes = slopes.reshape(-1, *slopes.shape[2:])
    valid = np.ones(coefficients.shape[:2], np.bool_)
    bare = _bare_southwell(*sensor.lenslets, sensor.lenslet_pitch_m)
    calls = {"svwfs": partial(_zonal, frames, slopes, valid), "scipy_splu": partial(bare, slopes)}
    return _timed("zonal solve", calls, "svwfs", budget_s)


def _images(frames: TimedFrames, budget_s: float) -> list[Row]:
    """Time the image of an object point, with the same phase in closed form."""
    calls, problem = {"svwfs": _square_of_points(frames)}, ""
    try:
        calls["hcipy"] = _hcipy_image(frames)
        calls["hcipy"]()
    except Exception as error:  # noqa: BLE001 - any problem of a peer is reported
        problem = f"{type(error).__name__}: {error}"
        calls.pop("hcipy", None)
    rows = _timed("image of a point", calls, "svwfs", budget_s, _POINTS**2)
    return rows + ([{"task": "image of a point", "by": "hcipy", "problem": problem}] if problem else [])


def _ours(frames: TimedFrames) -> Iterator[tuple[str, Callable[[], Wavefront]]]:
    """Yield name and call of every warp, cold and started at the previous frame, in one and two threads."""
    for warp, threads in product(_WARPS, (1, _THREADS)):
        reconstructor = frames.reconstructor(RegistrationSettings(warp=warp, threads=threads))
        for name, start in (("cold", None), ("warm", reconstructor.register(frames.before))):
            yield (
                f"{warp}, {name}, {threads} thread{'s' * (threads > 1)}",
                lambda reconstructor=reconstructor, start=start: reconstructor.solve(  # type: ignore[misc] # bound now
                    reconstructor.register(frames.frame, start=start)
                ),
            )


def residual_rad(frames: TimedFrames, coefficients: Floats) -> float:
    """Mean over the views of the RMS of the zonal wavefront minus the truth, rad.

    `coefficients` of the field modes, px, (lenslet, xy, field_mode), NaN for lost lenslets, which do not count.
    """
    if frames.truth is None:
        return math.nan
    sensor = frames.bench.sensor
    coefficients = coefficients.reshape(*sensor.lenslets, *coefficients.shape[1:])
    valid = np.asarray(np.isfinite(coefficients).all(axis=(2, 3)))
    slopes = _slopes(frames, np.swapaxes(coefficients, 2, 3))
    return float(np.nanmean(rms(_zonal(frames, slopes, valid) - frames.truth)))


def coefficients_of(displacement: Displacement) -> Floats:
    """Return the coefficients of displacements, px, (lenslet, xy, field_mode)."""
    found = displacement.coefficients
    return np.swapaxes(found.reshape(-1, *found.shape[2:]), 1, 2)


def _zonal(frames: TimedFrames, slopes: Floats, valid: Booleans) -> Floats:
    """Zonal wavefronts, rad, of slopes (..., lenslet_row, lenslet_column, xy), rad/m."""
    sensor = frames.bench.sensor
    return zonal_wavefront(slopes, valid, pitch_m=sensor.lenslet_pitch_m, arrangement=sensor.arrangement)


def _slopes(frames: TimedFrames, coefficients: Floats) -> Floats:
    """Slopes of all views, rad/m, (view_row, view_column, lenslet_row, lenslet_column, xy).

    `coefficients` (lenslet_row, lenslet_column, field_mode, xy), px.
    """
    field = frames.bench.field
    x, y = field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m
    modes = LegendreModes(coefficients.shape[2]).values(x, y[:, None])
    return np.asarray(np.einsum("rcqd,qyx->yxrcd", coefficients, modes) * frames.bench.sensor.slope_per_px)


def _bare_southwell(rows: int, columns: int, pitch_m: float) -> Callable[[Floats], Floats]:
    """Factorise Southwell's equations by SciPy's `splu` for a lattice without lost lenslets.

    Returns a function from slopes (case, lenslet_row, lenslet_column, xy), rad/m, to wavefronts (case, lenslet_row,
    lenslet_column), rad, without piston.
    """

    def steps(count: int) -> tuple[sparse.csr_array, sparse.csr_array]:
        shape = (count - 1, count)
        return (
            sparse.csr_array(sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=shape)),
            sparse.csr_array(sparse.diags_array([0.5, 0.5], offsets=[0, 1], shape=shape)),
        )

    (along_x, mean_x), (along_y, mean_y) = steps(columns), steps(rows)
    one_row, one_column = sparse.eye_array(columns), sparse.eye_array(rows)
    difference = sparse.vstack([sparse.kron(one_column, along_x), sparse.kron(along_y, one_row)]).tocsc()[:, 1:]
    average = sparse.block_diag([sparse.kron(one_column, mean_x), sparse.kron(mean_y, one_row)])
    factors = splu((difference.T @ difference).tocsc())
    right = (difference.T @ average * pitch_m).tocsr()

    def solve(slopes: Floats) -> Floats:
        flat = np.moveaxis(slopes, -1, 1).reshape(len(slopes), -1)
        phase = factors.solve(right @ flat.T)
        phase = np.concatenate([np.zeros((1, len(slopes))), phase])
        return np.asarray((phase - phase.mean(axis=0)).T.reshape(len(slopes), rows, columns))

    return solve


def _square_of_points(frames: TimedFrames) -> Callable[[], NDArray[Any]]:
    """Prepare the image (row, column) of a square of object points, m^2."""
    bench, (rows, columns) = frames.bench, frames.reference.shape
    model = ForwardModel(
        bench.sensor,
        frames.lattice,
        bench.field,
        shape=(rows, columns),
        pupil_samples=bench.simulation.pupil_samples,
        pixel_fill_factor=1.0,
        border_lenslets=0,
    )
    x_m, y_m = model.sample_x_m[None, :], model.sample_y_m[:, None]
    light = np.exp(1j * _BEND_RAD_PER_M2 * (x_m**2 + y_m**2)).astype(np.complex64)
    along_m = centered_steps(_POINTS) / _POINTS * 2 * bench.field.half_width_m
    position_m = np.stack(np.meshgrid(along_m, along_m), axis=-1).reshape(-1, 2)
    source = SourcePoints(position_m=position_m, area_m2=np.ones(len(position_m)))
    return lambda: model.irradiance(source, lambda _x, _y: light)


def _hcipy_image(frames: TimedFrames) -> Callable[[], NDArray[Any]]:
    """Prepare the image (row, column) of one object point."""
    hcipy = import_module("hcipy")
    sensor, (rows, columns) = frames.bench.sensor, frames.reference.shape
    width_m, height_m = (2 * half_m for half_m in sensor.pupil_half_width_m)
    grid = hcipy.make_pupil_grid([columns, rows], [width_m, height_m])
    lenslets = hcipy.CartesianGrid(hcipy.SeparatedCoords((sensor.pupil_x_m, sensor.pupil_y_m)))
    array = hcipy.MicroLensArray(grid, lenslets, sensor.lenslet_focal_length_m)
    propagator = hcipy.FresnelPropagator(grid, sensor.lenslet_focal_length_m)
    aside_m = frames.bench.field.half_width_m / 2
    tilt = sensor.wavenumber_rad_per_m / frames.bench.field.collimator_focal_length_m * aside_m * (grid.x + grid.y)
    phase = _BEND_RAD_PER_M2 * (grid.x**2 + grid.y**2) + tilt

    def image() -> NDArray[Any]:
        light = hcipy.Wavefront(hcipy.Field(np.exp(1j * phase), grid), sensor.wavelength_m)
        return np.asarray(propagator(array(light)).power)

    return image


class _Windows:
    """Cuts frames into subimages of whole pixels."""

    def __init__(self, frames: TimedFrames) -> None:
        self._dark = frames.dark
        self.pitch_px = round(frames.lattice.pitch_px)
        self.rows, self.columns = frames.bench.sensor.lenslets
        first = np.array([frames.lattice.center_y_px, frames.lattice.center_x_px])
        first -= (np.array([self.rows, self.columns]) * self.pitch_px - 1) / 2
        self.top, self.left = (round(float(value)) for value in first)

    def light(self, frame: NDArray[Any]) -> Image:
        """Counts above the dark, (row, column)."""
        return np.asarray(frame - self._dark, np.float32)

    def __call__(self, frame: NDArray[Any]) -> Image:
        """Subimages, counts above the dark, (lenslet, row, column)."""
        pitch_px = self.pitch_px
        inner = self.light(frame)[self.top :, self.left :][: self.rows * pitch_px, : self.columns * pitch_px]
        cells = inner.reshape(self.rows, pitch_px, self.columns, pitch_px).swapaxes(1, 2)
        return np.ascontiguousarray(cells.reshape(-1, pitch_px, pitch_px))


def _simple_itk(frames: TimedFrames) -> Register:
    affine, zonal = RegistrationSettings(method="itk_affine"), ReconstructionSettings(method="zonal")
    reconstructor = frames.reconstructor(affine, zonal)
    return lambda frame: coefficients_of(reconstructor.register(frame))


def _opencv_ecc(frames: TimedFrames, *, is_warm: bool = True, threads: int = _THREADS) -> Register:
    windows = _Windows(frames)
    references = windows(frames.reference)
    brightest = references.max()
    references /= brightest
    middle = np.full(2, (windows.pitch_px - 1) / 2)
    half_width_px = frames.bench.field.half_width_px(frames.bench.sensor)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ECC_STEPS, _ECC_TOLERANCE)
    starts = np.tile(np.eye(2, 3, dtype=np.float32), (len(references), 1, 1))
    over_all: Callable[..., Iterator[Image]] = map if threads == 1 else ThreadPoolExecutor(threads).map

    def align(reference: Image, subimage: Image, start: Image) -> Image:
        """Affine map (2, 3), px, from a subimage (row, column) of the reference to that of the frame."""
        warp = start.copy()
        try:
            found = cv2.findTransformECC(reference, subimage, warp, cv2.MOTION_AFFINE, criteria)
        except cv2.error:  # no convergence
            return np.full_like(start, np.nan)
        return np.asarray(found[1], np.float32)

    def warps(frame: NDArray[Any]) -> Image:
        """Affine maps (lenslet, 2, 3), px; NaN where lost."""
        return np.stack(list(over_all(align, references, windows(frame) / brightest, starts)))

    if is_warm:
        before = warps(frames.before)
        known = np.isfinite(before).all(axis=(1, 2))
        starts[known] = before[known]

    def register(frame: NDArray[Any]) -> Floats:
        found = warps(frame)
        stretch = found[:, :, :2] - np.eye(2)
        shift = stretch @ middle + found[:, :, 2]
        return np.concatenate([shift[..., None], stretch * half_width_px], axis=2)

    return register


def _scikit_image(frames: TimedFrames) -> Register:
    correlate = import_module("skimage.registration").phase_cross_correlation  # an optional extra
    windows = _Windows(frames)
    references = fft.fft2(windows(frames.reference), workers=_THREADS)

    def register(frame: NDArray[Any]) -> Floats:
        subimages = fft.fft2(windows(frame), workers=_THREADS)
        back = [
            correlate(one, other, space="fourier", upsample_factor=_TENTH, normalization=None)[0]
            for one, other in zip(references, subimages, strict=True)
        ]
        return -np.array(back)[:, ::-1, None]  # it returns the opposite shift, row first

    return register


def pyrtc(frames: TimedFrames, *, reach_px: int | None = None) -> Register:
    """Prepare pyrtcao's correlation up to `reach_px` pixels away, by default to the edge of the cell."""
    kernels = import_module("pyrtc.slopes_process")  # an optional extra
    windows, reach_px = _Windows(frames), _free_px(frames) if reach_px is None else reach_px
    lenslets, width = windows.rows, windows.pitch_px
    if windows.columns != lenslets:
        raise ValueError("pyrtcao's correlation needs a square lattice")
    core, shifts = width - 2 * reach_px, 2 * reach_px + 1
    templates = np.zeros((lenslets, lenslets, core, core), np.float32)
    flux = np.zeros((lenslets, lenslets), np.float32)
    spacing, threshold = np.float32(width), np.float32(0.0)
    place = (threshold, spacing, windows.left, windows.top, width)
    kernels.build_shwfs_correlation_templates_numba(windows.light(frames.reference), *place, reach_px, templates, flux)
    compute = kernels.compute_slopes_shwfs_correlation_numba
    slopes, zero = np.zeros((2, 2 * lenslets, lenslets), np.float32)
    window, scores = np.zeros((width, width), np.float32), np.zeros((shifts, shifts), np.float32)

    def register(frame: NDArray[Any]) -> Floats:
        compute(windows.light(frame), slopes, zero, *place, templates, flux, zero, reach_px, window, scores)
        return np.stack([slopes[:lenslets].ravel(), slopes[lenslets:].ravel()], axis=-1)[..., None].astype(np.float64)

    return register


def _free_px(frames: TimedFrames) -> int:
    """Whole pixels by which a subimage may move before it leaves its cell."""
    light, sensor = frames.reference - frames.dark, frames.bench.sensor
    reference = ReferenceSubimages(light, sensor=sensor, lattice=frames.lattice, field=frames.bench.field)
    return int(max(reference.reach_px - reference.half_width_px, _NO_SEARCH_PX))


PEERS: dict[str, Callable[[TimedFrames], Register]] = {
    "simpleitk_affine": _simple_itk,
    "opencv_ecc_affine": _opencv_ecc,
    "skimage_phase_correlation": _scikit_image,
    "pyrtc_correlation": pyrtc,
    # other uses of these
    "opencv_ecc_affine_cold": partial(_opencv_ecc, is_warm=False),
    "opencv_ecc_affine_one_thread": partial(_opencv_ecc, threads=1),
    "pyrtc_correlation_narrow": partial(pyrtc, reach_px=_NARROW_PX),
}
