"""The whole benchmark: everything on the same frames, side by side, as one dictionary that is written as JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.bench.config import Bench
from app.evaluation.benchmark import contestants
from app.evaluation.benchmark.cases import Case, noise_free, noisy
from app.evaluation.benchmark.forward import POINTS, hcipy_point, our_forward_model
from app.evaluation.benchmark.growth import four_k, growth
from app.evaluation.benchmark.ours import OURS, OURS_ONE_THREAD, coefficients_of, frames_per_s, ours
from app.evaluation.benchmark.residuals import residual_rad
from app.evaluation.benchmark.southwell import bare_southwell
from app.evaluation.benchmark.stopwatch import Times, side_by_side
from app.progress import Progress, between, named
from app.run_facts import machine_facts, versions
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import RegistrationSettings
from reconstruction.solve.zonal import zonal_wavefront
from reconstruction.wavefront import Wavefront, rms

Json = dict[str, Any]

# The ratios, and other uses of the same peers; which of these are held against ours in one thread.
_RATIOS = ("simpleitk_affine", "opencv_ecc_affine", "skimage_phase_correlation", "pyrtc_correlation")
_OWN_ROWS = ("opencv_ecc_affine_cold", "opencv_ecc_affine_one_thread", "pyrtc_correlation_narrow")
_ONE_THREAD = ("opencv_ecc_affine_one_thread",)
_NARROW_PX = 2  # as far as pyrtcao's correlation has to look for the subimages of these frames
_PACKAGES = ("SimpleITK", "scikit-image", "pyrtcao", "hcipy")


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is timed, and how long."""

    bench: Bench
    budget_s: float = 1.5  # for each of those that are timed side by side
    sizes: tuple[int, ...] = (5, 10, 15, 30, 64, 100)
    with_four_k: bool = True
    peers: tuple[str, ...] = (*_RATIOS, *_OWN_ROWS)


def run_benchmark(plan: Plan, progress: Progress) -> Json:
    """Run everything, BLAS in one thread as in the live path."""
    with one_blas_thread():
        return _run(plan, progress)


def _run(plan: Plan, progress: Progress) -> Json:
    progress("rendering", 0.0)
    clean = noise_free(plan.bench)
    grainy = noisy(clean, np.random.default_rng(1))
    race, residuals, missing = _race(clean, grainy, plan, _part(progress, 0.05, 0.5))
    seconds = {name: times.median_s for name, times in race.items()}
    progress("frames in a loop", 0.5)
    rate = frames_per_s(grainy, plan.budget_s)
    progress("zonal solve", 0.55)
    zonal = _zonal(grainy, plan.budget_s)
    progress("forward model", 0.6)
    forward = _forward(clean, plan.budget_s, missing)
    grown = growth(grainy, plan.sizes, plan.budget_s / 3, _part(progress, 0.65, 0.9))
    result: Json = {
        "ratios": {name: seconds[name] / seconds[OURS] for name in _RATIOS if name in seconds},
        "ratios_of_best": {name: race[name].best_s / race[OURS].best_s for name in _RATIOS if name in race},
        "ratios_of_other_uses": {
            name: seconds[name] / seconds[OURS_ONE_THREAD if name in _ONE_THREAD else OURS]
            for name in _OWN_ROWS
            if name in seconds
        },
        "frames_per_s": rate,
        "times": {
            name: {"median_s": times.median_s, "best_s": times.best_s, "calls": len(times.seconds)}
            for name, times in race.items()
        },
        "residuals_rad": residuals,
        "zonal": zonal,
        "forward": forward,
        "growth": [each.as_dict() for each in grown],
        "missing": missing,
        "machine": machine_facts(),
        "versions": versions(*_PACKAGES),
    }
    if plan.with_four_k:
        progress("64 x 64 lenslets on 2048 x 2048 pixels", 0.9)
        result["four_k"] = four_k(grainy, plan.budget_s / 3).as_dict()
    return result


def _race(
    clean: Case, grainy: Case, plan: Plan, progress: Progress
) -> tuple[dict[str, Times], dict[str, dict[str, float]], dict[str, str]]:
    """Times on the noisy frame, residuals on both, and who could not take part."""
    missing: dict[str, str] = {}
    residuals: dict[str, dict[str, float]] = {}
    with ExitStack() as stack:
        calls: dict[str, Callable[[], Any]] = dict(ours(grainy))
        for kind, case in (("noise_free", clean), ("noisy", grainy)):
            residuals[kind] = _our_residuals(case)
            for name in plan.peers:
                if name in missing:
                    continue
                progress(f"{name}, {kind.replace('_', ' ')}", 0.0)
                try:
                    register = stack.enter_context(_peer(name, case))
                    residuals[kind][name] = residual_rad(case, register(case.frame))
                except Exception as error:  # noqa: BLE001 - whatever keeps a peer away is told
                    missing[name] = f"{type(error).__name__}: {error}"
                    continue
                if case is grainy:
                    calls[name] = lambda register=register: register(grainy.frame)  # type: ignore[misc] # bound now
        return side_by_side(calls, plan.budget_s, progress), residuals, missing


def _our_residuals(case: Case) -> dict[str, float]:
    """Of every warp, by the zonal solve that peers have; and what the modal one makes of the same."""
    residuals = {}
    for name, call in ours(case):
        wavefront: Wavefront = call()
        residuals[name] = residual_rad(case, coefficients_of(wavefront))
        if name == OURS and case.truth is not None:
            residuals[f"{name}, modal"] = float(np.nanmean(rms(wavefront.views - case.truth)))
    return residuals


@contextmanager
def _peer(name: str, case: Case) -> Iterator[contestants.Register]:
    """Prepare a peer for a reference."""
    plain: Mapping[str, Callable[[], contestants.Register]] = {
        "simpleitk_affine": lambda: contestants.simple_itk(case),
        "skimage_phase_correlation": lambda: contestants.scikit_image(case),
        "pyrtc_correlation": lambda: contestants.pyrtc(case, reach_px=contestants.reach_px(case)),
        "pyrtc_correlation_narrow": lambda: contestants.pyrtc(case, reach_px=_NARROW_PX),
    }
    if name in plain:
        yield plain[name]()
        return
    threads, is_warm = 1 if name.endswith("one_thread") else 2, not name.endswith("cold")
    with contestants.opencv_ecc(case, is_warm=is_warm, threads=threads) as register:
        yield register


def _zonal(case: Case, budget_s: float) -> Json:
    """The zonal solve of all views beside bare equations of the same kind."""
    sensor, field = case.sensor, case.field
    reconstructor = case.reconstructor(RegistrationSettings(warp="quadratic"))
    coefficients = reconstructor.register(case.frame).coefficients
    x, y = field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m
    views = LegendreModes(coefficients.shape[2]).values(x, y[:, None]).reshape(coefficients.shape[2], -1)
    slopes = np.einsum("rcqd,qv->vrcd", np.nan_to_num(coefficients), views) * sensor.slope_per_px
    valid = np.ones(coefficients.shape[:2], np.bool_)
    bare = bare_southwell(sensor.lenslet_rows, sensor.lenslet_columns, sensor.lenslet_pitch_m)

    def own() -> Any:
        return zonal_wavefront(slopes, valid, pitch_m=sensor.lenslet_pitch_m)

    times = side_by_side({"ours": own, "bare": lambda: bare(slopes)}, budget_s / 2)
    return {
        "ours_s": times["ours"].median_s,
        "scipy_splu_s": times["bare"].median_s,
        "ratio": times["bare"].median_s / times["ours"].median_s,
        "largest_difference_rad": float(np.abs(own() - bare(slopes)).max()),
    }


def _forward(case: Case, budget_s: float, missing: dict[str, str]) -> Json:
    """Seconds an object point."""
    calls: dict[str, Callable[[], Any]] = {"ours": our_forward_model(case)}
    try:
        calls["hcipy"] = hcipy_point(case)
        calls["hcipy"]()
    except Exception as error:  # noqa: BLE001 - whatever keeps a peer away is told
        missing["hcipy"] = f"{type(error).__name__}: {error}"
        calls.pop("hcipy", None)
    times = side_by_side(calls, budget_s)
    found: Json = {"ours_s_per_point": times["ours"].median_s / POINTS**2}
    if "hcipy" in times:
        found["hcipy_s_per_point"] = times["hcipy"].median_s
        found["ratio"] = found["hcipy_s_per_point"] / found["ours_s_per_point"]
    return found


def _part(progress: Progress, first: float, last: float) -> Progress:
    """Return the callback for the share of the work from `first` to `last`."""
    return named(between(progress, first, last), "timing")
