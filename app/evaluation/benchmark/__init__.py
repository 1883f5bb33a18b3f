"""The benchmark: a tree of times and residuals on the same frames, side by side.

Registration beside the contestants; zonal solve and forward model beside other software; frames of growing lattices.
"""

import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from app.bench.config import Bench
from app.evaluation.benchmark.contestants import OURS, PEERS, coefficients_of, frames_per_s, ours
from app.evaluation.benchmark.timed_frames import TimedFrames, medians_s, noise_free, noisy, side_by_side, tiled
from app.progress import Progress, between, named
from app.run_facts import machine_facts, versions
from reconstruction.arrays import Booleans, Floats
from reconstruction.geometry import centered_steps
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import FIELD_MODES, RegistrationSettings, Warp
from reconstruction.solve.zonal import ZonalSolution, zonal_wavefront
from reconstruction.wavefront import Wavefront, rms
from simulated_devices.optics.forward_model import ForwardModel, phase_only
from simulated_devices.optics.source import SourcePoints

Json = dict[str, Any]

_RATIOS = ("simpleitk_affine", "opencv_ecc_affine", "skimage_phase_correlation", "pyrtc_correlation")
_PACKAGES = ("SimpleITK", "scikit-image", "pyrtcao", "hcipy")
_SIZES = (5, 10, 15, 30, 64, 100)  # lenslets along a side


def run_benchmark(
    bench: Bench,
    progress: Progress,
    *,
    budget_s: float = 1.5,
    sizes: Sequence[int] = _SIZES,
    peers: Sequence[str] = tuple(PEERS),
    with_four_k: bool = True,
) -> Json:
    """Run everything with BLAS in one thread, as in the live path, each contestant for `budget_s`."""
    with one_blas_thread():
        progress("rendering", 0.0)
        clean = noise_free(bench)
        grainy = noisy(clean, np.random.default_rng(1))
        result = _race(clean, grainy, peers, budget_s, named(between(progress, 0.05, 0.5), "timing"))
        progress("frames in a loop", 0.5)
        result["frames_per_s"] = frames_per_s(grainy, budget_s)
        progress("zonal solve", 0.55)
        result["zonal"] = _zonal_times(grainy, budget_s / 2)
        progress("one layer", 0.58)
        result["layer"] = _layer_times(grainy, budget_s / 2)
        progress("forward model", 0.6)
        result["forward"], problem = _forward_times(clean, budget_s)
        if problem:
            result["missing"]["hcipy"] = problem
        step = named(between(progress, 0.65, 0.9), "timing")
        result["growth"] = _growth(grainy, sizes, budget_s / 3, step)
        if with_four_k:
            progress("64 x 64 lenslets on 2048 x 2048 pixels", 0.9)
            large = tiled(grainy, _LARGE_LENSLETS, margin_px=_LARGE_MARGIN_PX)
            result["four_k"] = _timed(large, "quadratic", budget_s / 3)
        return result | {"machine": machine_facts(), "versions": versions(*_PACKAGES)}


def _race(clean: TimedFrames, grainy: TimedFrames, peers: Sequence[str], budget_s: float, progress: Progress) -> Json:
    """Times on the noisy frame, residuals on both, and the reasons for missing peers."""
    missing: dict[str, str] = {}
    residuals: dict[str, dict[str, float]] = {}
    calls: dict[str, Callable[[], Any]] = dict(ours(grainy))
    for kind, frames in (("noise_free", clean), ("noisy", grainy)):
        residuals[kind] = _our_residuals(frames)
        for name in peers:
            if name in missing:
                continue
            progress(f"{name}, {kind.replace('_', ' ')}", 0.0)
            try:
                register = PEERS[name](frames)
                residuals[kind][name] = _residual_rad(frames, register(frames.frame))
            except Exception as error:  # noqa: BLE001 - any problem of a peer is reported
                missing[name] = f"{type(error).__name__}: {error}"
                continue
            if frames is grainy:
                calls[name] = partial(register, grainy.frame)
    seconds = side_by_side(calls, budget_s, progress)
    times = {
        name: {"median_s": float(np.median(each)), "best_s": min(each), "calls": len(each)}
        for name, each in seconds.items()
    }

    return {
        "ratios": {name: times[name]["median_s"] / times[OURS]["median_s"] for name in _RATIOS if name in times},
        "times": times,
        "residuals_rad": residuals,
        "missing": missing,
    }


def _our_residuals(frames: TimedFrames) -> dict[str, float]:
    """Residuals, rad, of every warp by the peers' zonal solve, and of the modal wavefront of `OURS`."""
    residuals = {}
    for name, call in ours(frames):
        wavefront = call()
        residuals[name] = _residual_rad(frames, coefficients_of(wavefront.displacement))
        if name == OURS and frames.truth is not None:
            residuals[f"{name}, modal"] = float(np.nanmean(rms(wavefront.views - frames.truth)))
    return residuals


def _residual_rad(frames: TimedFrames, coefficients: Floats) -> float:
    """Mean over the views of the RMS of the zonal wavefront minus the truth, rad; NaN without a truth.

    `coefficients` of the field modes, px, (lenslet, xy, field_mode), NaN for lost lenslets, which do not count.
    """
    if frames.truth is None:
        return math.nan
    sensor = frames.bench.sensor
    coefficients = coefficients.reshape(sensor.lenslet_rows, sensor.lenslet_columns, *coefficients.shape[1:])
    valid = np.asarray(np.isfinite(coefficients).all(axis=(2, 3)))
    slopes = _slopes(frames, np.swapaxes(coefficients, 2, 3))
    return float(np.nanmean(rms(_zonal(frames, slopes, valid) - frames.truth)))


def _zonal_times(frames: TimedFrames, budget_s: float) -> dict[str, float]:
    """Time the zonal solve of all views beside bare equations of the same kind."""
    sensor = frames.bench.sensor
    coefficients = frames.reconstructor(RegistrationSettings(warp="quadratic")).register(frames.frame).coefficients
    slopes = _slopes(frames, np.nan_to_num(coefficients))
    slopes = slopes.reshape(-1, *slopes.shape[2:])
    valid = np.ones(coefficients.shape[:2], np.bool_)
    bare = _bare_southwell(sensor.lenslet_rows, sensor.lenslet_columns, sensor.lenslet_pitch_m)
    ours = partial(_zonal, frames, slopes, valid)
    times_s = medians_s({"ours": ours, "bare": lambda: bare(slopes)}, budget_s)
    return {
        "ours_s": times_s["ours"],
        "scipy_splu_s": times_s["bare"],
        "ratio": times_s["bare"] / times_s["ours"],
        "largest_difference_rad": float(np.abs(ours() - bare(slopes)).max()),
    }


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


_RATIO = -0.975  # of field to pupil position: 195 mm in front of the lenslets of the paper's bench


def _layer_times(frames: TimedFrames, budget_s: float) -> dict[str, float]:
    """Return seconds from displacements to a layer at a known distance, and to layers at unknown ones."""
    reconstructor = frames.reconstructor(RegistrationSettings())
    displacement = reconstructor.register(frames.frame)
    calls: dict[str, Callable[[], Any]] = {
        "known_s": lambda: reconstructor.layers(displacement).fit(_RATIO),
        "search_s": partial(reconstructor.find_sample, displacement),
    }
    return medians_s(calls, budget_s)


_POINTS = 8  # along a side
_BEND_RAD_PER_M2 = 3e5


def _forward_times(frames: TimedFrames, budget_s: float) -> tuple[dict[str, float], str]:
    """Time our forward model and HCIPy's per object point, s; return also why HCIPy cannot run.

    Both get the same phase in closed form and the same object points. Ours repeats its costs per image for these few
    points and covers the camera's pixels with squares of light; HCIPy has one sample per pixel.
    """
    calls, problem = {"ours": _our_image(frames)}, ""
    try:
        hcipy = _hcipy_image(frames)
        hcipy()
        calls["hcipy"] = hcipy
    except Exception as error:  # noqa: BLE001 - any problem of a peer is reported
        problem = f"{type(error).__name__}: {error}"
    times_s = medians_s(calls, budget_s)
    found = {"ours_s_per_point": times_s["ours"] / _POINTS**2}
    if "hcipy" in times_s:
        found |= {"hcipy_s_per_point": times_s["hcipy"], "ratio": times_s["hcipy"] / found["ours_s_per_point"]}
    return found, problem


def _our_image(frames: TimedFrames) -> Callable[[], NDArray[Any]]:
    """Prepare the image (row, column) of a square of object points, m^2."""
    bench, (rows, columns) = frames.bench, frames.reference.shape
    samples = bench.simulation.pupil_samples
    model = ForwardModel(
        bench.sensor,
        frames.lattice,
        bench.field,
        shape=(rows, columns),
        pupil_samples=samples,
        pixel_fill_factor=1.0,
        border_lenslets=0,
    )
    x_m, y_m = model.sample_x_m[None, :], model.sample_y_m[:, None]
    bend = (_BEND_RAD_PER_M2 * (x_m**2 + y_m**2)).astype(np.float32)
    position_m = _positions_m(frames, _POINTS)
    source = SourcePoints(position_m=position_m, area_m2=np.ones(len(position_m)))
    return lambda: model.irradiance(source, phase_only(lambda _x, _y: bend))


def _hcipy_image(frames: TimedFrames) -> Callable[[], NDArray[Any]]:
    """Prepare the image (row, column) of one object point."""
    hcipy = import_module("hcipy")
    sensor, (rows, columns) = frames.bench.sensor, frames.reference.shape
    width_m, height_m = (2 * half_m for half_m in sensor.pupil_half_width_m)
    grid = hcipy.make_pupil_grid([columns, rows], [width_m, height_m])
    lenslets = hcipy.CartesianGrid(hcipy.SeparatedCoords((sensor.pupil_x_m, sensor.pupil_y_m)))
    array = hcipy.MicroLensArray(grid, lenslets, sensor.lenslet_focal_length_m)
    propagator = hcipy.FresnelPropagator(grid, sensor.lenslet_focal_length_m)
    x_m, y_m = _positions_m(frames, 2)[-1]
    tilt = sensor.wavenumber_rad_per_m / frames.bench.field.collimator_focal_length_m * (grid.x * x_m + grid.y * y_m)
    phase = _BEND_RAD_PER_M2 * (grid.x**2 + grid.y**2) + tilt

    def image() -> NDArray[Any]:
        light = hcipy.Wavefront(hcipy.Field(np.exp(1j * phase), grid), sensor.wavelength_m)
        return np.asarray(propagator(array(light)).power)

    return image


def _positions_m(frames: TimedFrames, points: int) -> NDArray[np.float64]:
    """Object points on a square, m, (point, xy)."""
    along_m = centered_steps(points) / points * 2 * frames.bench.field.half_width_m
    return np.stack(np.meshgrid(along_m, along_m), axis=-1).reshape(-1, 2)


_LARGE_LENSLETS, _LARGE_MARGIN_PX = 64, 32  # 31 pixels each on 2048 x 2048


def _growth(frames: TimedFrames, sizes: Sequence[int], budget_s: float, progress: Progress) -> list[dict[str, float]]:
    """Time quadratic warps on lattices of several sizes, affine and cubic ones on their own."""
    own = frames.bench.sensor.lenslet_rows
    cases: list[tuple[int, Warp]] = []
    for size in dict.fromkeys((*sizes, own)):
        cases += [(size, "quadratic")] * (size in sizes)
        cases += [(size, "affine"), (size, "cubic")] if size == own else []
    found = []
    for index, (size, warp) in enumerate(cases):
        progress(f"{size} x {size} lenslets, {warp}", index / len(cases))
        found.append(_timed(tiled(frames, size), warp, budget_s))
    return found


def _timed(frames: TimedFrames, warp: Warp, budget_s: float) -> dict[str, float]:
    lenslets = frames.bench.sensor.lenslet_rows
    start_s = time.perf_counter()
    reconstructor = frames.reconstructor(RegistrationSettings(warp=warp))
    before = reconstructor.register(frames.before)
    reconstructor.solve(before)  # computes the factors of the lenslets' weights once
    prepare_s = time.perf_counter() - start_s
    displacement = reconstructor.register(frames.frame, start=before)
    sensor = frames.bench.sensor
    zonal = ZonalSolution(
        slopes=displacement.coefficients * sensor.slope_per_px,
        valid=displacement.valid,
        pitch_m=sensor.lenslet_pitch_m,
        arrangement=sensor.arrangement,
        weights=reconstructor.weights_of(displacement),
    )
    times_s = medians_s(
        {
            "register_s": partial(reconstructor.register, frames.frame, start=before),  # warm
            "zonal_s": partial(Wavefront.of, sensor, frames.bench.field, displacement, zonal),
            "modal_s": partial(reconstructor.solve, displacement),  # modes chosen from the lattice
            # counts to all views and coefficients: register and modal
            "frame_s": lambda: reconstructor.solve(reconstructor.register(frames.frame, start=before)),
        },
        budget_s,
    )
    found = {
        "lenslets": lenslets,  # along a side
        "field_modes": FIELD_MODES[warp],
        "frame_px": frames.reference.shape[0],  # along a side
        "prepare_s": prepare_s,  # from a new reference to the first wavefronts
        **times_s,
        "per_lenslet_us": times_s["frame_s"] / lenslets**2 * 1e6,
    }
    if sys.platform != "win32":  # which does not tell
        import resource  # noqa: PLC0415 - not there on Windows

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # of this process so far
        found["peak_memory_mb"] = peak / 2**20 if sys.platform == "darwin" else peak / 2**10
    return found


_TOLERANCE = 0.2  # of the speed before; a larger loss fails


def load_baseline() -> dict[str, float]:
    """Return the committed ratios: the peers' times over ours.

    Measured side by side, they hardly depend on the computer. After a lasting improvement copy "ratios" from the file
    of `svwfs benchmark --json`.
    """
    ratios: dict[str, float] = json.loads(Path(__file__).with_name("baseline.json").read_text("utf-8"))["ratios"]
    return ratios


def worsened(ratios: Mapping[str, float], baseline: Mapping[str, float]) -> list[str]:
    """Return a sentence for each ratio that is missing or worse by more than 20 %."""
    problems = []
    for name, before in baseline.items():
        now = ratios.get(name)
        if now is None:
            problems.append(f"{name}: was {before:.3g}, could not be measured now")
        elif now < (1 - _TOLERANCE) * before:
            problems.append(f"{name}: {now:.3g} times faster, was {before:.3g}")
    return problems
