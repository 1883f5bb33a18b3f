"""Residuals with other sources, dead lenslets, and settings that are wrong."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from app.bench.config import Bench
from app.bench.imaging_model import by_pixel
from app.evaluation.frames import NoiseFreeFrames, seeded, with_source
from app.evaluation.mask_accuracy import lit_views
from app.measurement.estimator import ROUNDS
from reconstruction.layers.layered_wavefront import FREE
from studies.estimators import compare, residual, warp_estimators
from studies.tables import Asked, Made, Row, curves, draw_curves, steps

_MASKS = "square", "checkerboard", "circle", "octagon", "ellipse", "peaks"


def source(asked: Asked, masks: Sequence[str] = _MASKS) -> Made:
    """Residual of every warp with other shapes of the source, in the views inside it."""
    rows: list[Row] = []
    for mask in steps(masks, "sources"):
        bench = with_source(asked.bench, mask=mask)
        views, estimators = lit_views(bench), warp_estimators(bench, NoiseFreeFrames(bench).reference())
        for screen in seeded(bench, asked.seeds):
            frame = NoiseFreeFrames(screen).frame()
            rows += compare(estimators, frame.photons, frame.truth, at=mask, views=views)
    table = curves(rows)
    return table, draw_curves(table, "Source (views inside it)", "shape")


def lattice(asked: Asked, errors_px: Sequence[float] = (0.0, 0.5, 1.0, 2.0, 3.0)) -> Made:
    """Residual if centre, pitch or rotation of the lattice are wrong."""

    def wrong(bench: Bench, kind: str, error_px: float) -> Bench:
        """Shift the outermost lenslets by an error."""
        right = bench.design_lattice(bench.camera_model.rows, bench.camera_model.columns)
        far_px = (max(bench.sensor.lenslets) - 1) / 2 * right.pitch_px
        changes: dict[str, dict[str, Any]] = {
            "centre": {"center_x_px": right.center_x_px + error_px},
            "pitch": {"pitch_px": right.pitch_px * (1 + error_px / far_px)},
            "rotation": {"rotation_rad": right.rotation_rad + error_px / far_px},
        }
        return replace(bench, lattice=replace(right, **changes[kind]))

    table = _over_errors(asked, ("centre", "pitch", "rotation"), errors_px, wrong)
    return table, draw_curves(table, "Lattice is wrong", "error at the outermost lenslets (px)")


def focal_length(asked: Asked, errors: Sequence[float] = (-0.05, -0.02, 0.0, 0.02, 0.05)) -> Made:
    """Residual if a focal length, of the lenslets or of the collimator, is wrong."""

    def wrong(bench: Bench, kind: str, error: float) -> Bench:
        sensor, field = bench.sensor, bench.field
        if kind == "lenslets":
            longer_m = sensor.lenslet_focal_length_m * (1 + error)
            return replace(bench, sensor=replace(sensor, lenslet_focal_length_m=longer_m))
        longer_m = field.collimator_focal_length_m * (1 + error)
        return replace(bench, field=replace(field, collimator_focal_length_m=longer_m))

    table = _over_errors(asked, ("lenslets", "collimator"), errors, wrong)
    return table, draw_curves(table, "Focal length is wrong", "relative error")


def _over_errors(
    asked: Asked, kinds: tuple[str, ...], values: Sequence[float], wrong: Callable[[Bench, str, float], Bench]
) -> pd.DataFrame:
    """Reconstruct frames with the settings of a wrong bench, for each kind and size of error."""
    reference, rows = NoiseFreeFrames(asked.bench).reference(), list[Row]()
    frames = [NoiseFreeFrames(screen).frame() for screen in seeded(asked.bench, asked.seeds)]
    for kind, value in steps(list(product(kinds, values)), "errors"):
        estimators = warp_estimators(wrong(asked.bench, kind, value), reference, ("quadratic", "cubic"))
        for frame in frames:
            prefix = f"{kind}: "
            rows += compare(estimators, frame.photons, frame.truth, at=value, prefix=prefix, refined=("cubic",))
    return curves(rows)


def dead(asked: Asked, shares: Sequence[float] = (0.0, 0.05, 0.1, 0.2, 0.3)) -> Made:
    """Residual with dead lenslets, and of the wavefront at the dead ones."""
    bench, rows = asked.bench, list[Row]()
    reference, shape = NoiseFreeFrames(bench).reference(), bench.sensor.lenslets
    lenslets = bench.design_lattice(*reference.shape)
    for screen, fraction in steps(list(product(seeded(bench, asked.seeds), shares)), "dead lenslets"):
        frame = NoiseFreeFrames(screen).frame()
        order = np.random.default_rng(screen.simulation.seed).permutation(shape[0] * shape[1])
        alive = np.ones(order.size)
        alive[order[: round(fraction * order.size)]] = 0.0
        alive = alive.reshape(shape)
        light = by_pixel(alive, lenslets, *reference.shape)
        estimators = warp_estimators(bench, reference * light)
        rows += compare(estimators, frame.photons * light, frame.truth, at=fraction, refined=("cubic",))
        if fraction > 0:
            displacement = estimators["cubic"].reconstructor.register(frame.photons * light)
            wavefront, _ = estimators["cubic"].solve(displacement, sample=FREE, rounds=ROUNDS)
            curve, there = "cubic refined, at the dead ones", alive == 0.0
            rows.append(residual(wavefront, frame.truth, curve=curve, at=fraction, lenslets=there))
    table = curves(rows)
    return table, draw_curves(table, "Dead lenslets", "part of all lenslets")
