"""The benchmark: everything on the same frames, side by side, as one tree for JSON, and the ratios to keep."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from app.bench.config import Bench
from app.evaluation.benchmark.contestants import OURS, OURS_ONE_THREAD, PEERS, coefficients_of, frames_per_s, ours
from app.evaluation.benchmark.part_times import (
    forward_times,
    growth,
    large_camera,
    layer_times,
    residual_rad,
    zonal_times,
)
from app.evaluation.benchmark.timed_frames import TimedFrames, noise_free, noisy, side_by_side
from app.progress import Progress, between, named
from app.run_facts import machine_facts, versions
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.wavefront import rms

Json = dict[str, Any]

_RATIOS = ("simpleitk_affine", "opencv_ecc_affine", "skimage_phase_correlation", "pyrtc_correlation")
_OTHER_USES = ("opencv_ecc_affine_cold", "opencv_ecc_affine_one_thread", "pyrtc_correlation_narrow")
_ONE_THREAD = ("opencv_ecc_affine_one_thread",)  # compared with ours in one thread
_PACKAGES = ("SimpleITK", "scikit-image", "pyrtcao", "hcipy")


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchmarkPlan:
    """Bench, extent and duration of the benchmark."""

    bench: Bench
    budget_s: float = 1.5  # per contestant
    sizes: tuple[int, ...] = (5, 10, 15, 30, 64, 100)
    with_four_k: bool = True
    peers: tuple[str, ...] = tuple(PEERS)


def run_benchmark(plan: BenchmarkPlan, progress: Progress) -> Json:
    """Run everything with BLAS in one thread, as in the live path."""
    with one_blas_thread():
        progress("rendering", 0.0)
        clean = noise_free(plan.bench)
        grainy = noisy(clean, np.random.default_rng(1))
        result = _race(clean, grainy, plan, named(between(progress, 0.05, 0.5), "timing"))
        progress("frames in a loop", 0.5)
        result["frames_per_s"] = frames_per_s(grainy, plan.budget_s)
        progress("zonal solve", 0.55)
        result["zonal"] = zonal_times(grainy, plan.budget_s / 2)
        progress("one layer", 0.58)
        result["layer"] = layer_times(grainy, plan.budget_s / 2)
        progress("forward model", 0.6)
        result["forward"], problem = forward_times(clean, plan.budget_s)
        if problem:
            result["missing"]["hcipy"] = problem
        step = named(between(progress, 0.65, 0.9), "timing")
        result["growth"] = growth(grainy, plan.sizes, plan.budget_s / 3, step)
        if plan.with_four_k:
            progress("64 x 64 lenslets on 2048 x 2048 pixels", 0.9)
            result["four_k"] = large_camera(grainy, plan.budget_s / 3)
        return result | {"machine": machine_facts(), "versions": versions(*_PACKAGES)}


def _race(clean: TimedFrames, grainy: TimedFrames, plan: BenchmarkPlan, progress: Progress) -> Json:
    """Times on the noisy frame, residuals on both, and the reasons for missing peers."""
    missing: dict[str, str] = {}
    residuals: dict[str, dict[str, float]] = {}
    calls: dict[str, Callable[[], Any]] = dict(ours(grainy))
    for kind, frames in (("noise_free", clean), ("noisy", grainy)):
        residuals[kind] = _our_residuals(frames)
        for name in plan.peers:
            if name in missing:
                continue
            progress(f"{name}, {kind.replace('_', ' ')}", 0.0)
            try:
                register = PEERS[name](frames)
                residuals[kind][name] = residual_rad(frames, register(frames.frame))
            except Exception as error:  # noqa: BLE001 - any problem of a peer is reported
                missing[name] = f"{type(error).__name__}: {error}"
                continue
            if frames is grainy:
                calls[name] = partial(register, grainy.frame)
    seconds = side_by_side(calls, plan.budget_s, progress)
    times = {
        name: {"median_s": float(np.median(each)), "best_s": min(each), "calls": len(each)}
        for name, each in seconds.items()
    }

    def ratio(name: str, other: str = OURS, kind: str = "median_s") -> float:
        return times[name][kind] / times[other][kind]

    return {
        "ratios": {name: ratio(name) for name in _RATIOS if name in times},
        "ratios_of_best": {name: ratio(name, kind="best_s") for name in _RATIOS if name in times},
        "ratios_of_other_uses": {
            name: ratio(name, OURS_ONE_THREAD if name in _ONE_THREAD else OURS) for name in _OTHER_USES if name in times
        },
        "times": times,
        "residuals_rad": residuals,
        "missing": missing,
    }


def _our_residuals(frames: TimedFrames) -> dict[str, float]:
    """Residuals of every warp by the zonal solve that the peers get, and of the modal wavefront of `OURS`."""
    residuals = {}
    for name, call in ours(frames):
        wavefront = call()
        residuals[name] = residual_rad(frames, coefficients_of(wavefront.displacement))
        if name == OURS and frames.truth is not None:
            residuals[f"{name}, modal"] = float(np.nanmean(rms(wavefront.views - frames.truth)))
    return residuals


_TOLERANCE = 0.2  # of the speed before; a larger loss fails


def load_baseline() -> dict[str, float]:
    """Return the committed ratios: the peers' times over ours, side by side, which hardly depend on the computer.

    After a lasting improvement copy "ratios" from the file of `svwfs benchmark --json`.
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
