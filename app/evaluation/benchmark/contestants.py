"""Registration by svwfs and by other libraries, each in its best use, prepared for a reference.

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
"""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from app.evaluation.benchmark.timed_frames import TimedFrames
from reconstruction.arrays import Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, Warp
from reconstruction.wavefront import Wavefront

Register = Callable[[NDArray[Any]], Floats]
"""Takes counts (row, column), returns coefficients c_q of 1, x / h, y / h, px, (lenslet, xy, 1 or 3)."""

_THREADS = 2
_TENTH = 10  # steps per pixel of the found shift
_ECC_STEPS, _ECC_TOLERANCE = 50, 1e-3  # defaults of findTransformECC
_NO_SEARCH_PX = 1.0
_NARROW_PX = 2  # reach of pyrtcao's correlation that suffices for these frames


class _Windows:
    """Cuts frames into subimages of whole pixels."""

    def __init__(self, frames: TimedFrames) -> None:
        self._dark = frames.dark
        self.pitch_px = round(frames.lattice.pitch_px)
        self.rows, self.columns = frames.bench.sensor.lenslet_rows, frames.bench.sensor.lenslet_columns
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

WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic")
THREADS = (1, 2)


def _name_of(warp: Warp, *, is_warm: bool, threads: int) -> str:
    return f"{warp}, {'warm' if is_warm else 'cold'}, {threads} thread{'s' * (threads > 1)}"


OURS = _name_of("quadratic", is_warm=True, threads=2)


def ours(frames: TimedFrames) -> Iterator[tuple[str, Callable[[], Wavefront]]]:
    """Yield name and call of every warp, cold and started at the previous frame, in one and two threads."""
    for warp, threads in product(WARPS, THREADS):
        reconstructor = frames.reconstructor(RegistrationSettings(warp=warp, threads=threads))
        before = reconstructor.register(frames.before)
        for is_warm in (False, True):
            start = before if is_warm else None
            yield (
                _name_of(warp, is_warm=is_warm, threads=threads),
                lambda reconstructor=reconstructor, start=start: reconstructor.solve(  # type: ignore[misc] # bound now
                    reconstructor.register(frames.frame, start=start)
                ),
            )


def coefficients_of(displacement: Displacement) -> Floats:
    """Return the coefficients of displacements, px, (lenslet, xy, field_mode)."""
    found = displacement.coefficients
    return np.swapaxes(found.reshape(-1, *found.shape[2:]), 1, 2)


def frames_per_s(frames: TimedFrames, seconds: float) -> float:
    """Return the rate of a loop of warm frames, 1/s."""
    reconstructor = frames.reconstructor(RegistrationSettings(warp="quadratic"))
    displacement = reconstructor.register(frames.before)
    count, start_s = 0, time.perf_counter()
    while time.perf_counter() < start_s + seconds:
        for frame in (frames.frame, frames.before):
            displacement = reconstructor.register(frame, start=displacement)
            reconstructor.solve(displacement)
            count += 1
    return count / (time.perf_counter() - start_s)
