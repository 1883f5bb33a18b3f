"""Accuracy of source masks: predicted next to a full simulation, and many compared by prediction alone."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from app.bench.config import Bench
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, seeded, with_screen, with_source
from app.evaluation.mask_accuracy import (
    PEAKS_E,
    WARP,
    bound_rad,
    calibration_of,
    linear_pass,
    lit_views,
    predicted_accuracies,
    with_mask,
    without_prior,
)
from reconstruction.arrays import Booleans, Image
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.wavefront import mean_rms
from studies.estimators import camera, residual, row, scatter_of
from studies.screens import NEAR_SOURCE
from studies.tables import Asked, Made, Row, curves, draw_curves, steps

_SIMULATED_E = (300.0, 1e3)  # light of the simulated noise
_PICTURES = (".npy", ".png", ".tif", ".tiff")
_SAMPLES: dict[str, dict[str, Any]] = {"bench": {}, "source": NEAR_SOURCE | {"rms_rad": 2.0}}  # changes of the screen


def mask(asked: Asked, draws: int = 40) -> Made:
    """Figures of `svwfs mask MASK --accuracy` for masks and the square, next to a full simulation."""
    benches, rows = {name: named_mask(asked.bench, name) for name in ("square", *asked.masks)}, list[Row]()
    for name, bench in steps([*benches.items()], "masks"):
        for screen in seeded(bench, asked.seeds):
            predicted = predicted_accuracies(screen, lambda *_: None)[bench.simulation.source.mask]
            rows += [{"curve": figure, "at": name, "rms_rad": value} for figure, value in predicted.items()]
            rows += _simulated_residuals(screen, name)
        rows += _simulated_noise(bench, name, draws)
    table = curves(rows)
    return table, draw_curves(table, f"Masks in one pass, noise with the {WARP} warp", "mask")


def named_mask(bench: Bench, name: str) -> Bench:
    """Return the bench with a mask as `svwfs mask` names it, or a checkerboard as checkerboard:5."""
    kind, _, cells = name.partition(":")
    if kind != "checkerboard" or not cells.isdecimal():
        return with_mask(bench, name)
    try:
        return with_source(bench, mask=kind, checker_cells=int(cells))
    except ValueError as error:  # too few, or too many to count
        raise InputError(f"mask {name}: {error}") from error


def _simulated_residuals(bench: Bench, at: str) -> Iterator[Row]:
    """Yield the residuals, rad, of one noise-free pass: without assumption, and over the layers found."""
    frames, views = NoiseFreeFrames(bench), lit_views(bench)
    reconstructor = calibration_of(bench, frames.reference()).reconstructor()
    frame = frames.frame()
    displacement = reconstructor.register(frame.photons)
    for assumed, sample in (("any wavefront", FREE), ("layers", reconstructor.find_sample(displacement))):
        wavefront = reconstructor.solve(displacement, sample=sample)
        yield residual(wavefront, frame.truth, curve=f"residual, {assumed}: simulated", at=at, views=views)


def _simulated_noise(bench: Bench, at: str, draws: int) -> Iterator[Row]:
    """Yield the scatter over draws of noise, rad, at equal peak, and in the exposure of the square."""
    frames, views, em_camera = NoiseFreeFrames(bench), lit_views(bench), camera(bench)
    reference, frame = frames.reference(), frames.frame().photons
    for label, peak in (("", reference.max()), (" in the square", frames.reference("square").max())):
        for peak_e in _SIMULATED_E:
            scale, prior = np.float32(peak_e / peak), without_prior(bench)
            reconstructor = em_camera.reconstructor(bench, reference * scale, WARP, reconstruction=prior)
            without = reconstructor(em_camera.counts(frame * scale))
            seed = bench.simulation.seed
            noisy = (reconstructor(em_camera.exposed(frame * scale, seed, draw)) for draw in range(draws))
            scatter = scatter_of(noisy, without.views, views)
            yield row(without, scatter.rms_rad, curve=f"noise, {peak_e:g} e-{label}: simulated", at=at)


def masks(asked: Asked) -> Made:
    """Bound and bias of many masks, predicted, against the light that each lets through; folders of pictures, too.

    The exposure is equal: it gives a plain square some electrons in the brightest pixel of its reference.
    """
    names, found = list(dict.fromkeys(["square", *_pictures_of(asked.masks)])), list[Row]()
    square, views = NoiseFreeFrames(asked.bench).reference("square"), lit_views(with_source(asked.bench, mask="square"))
    for name in steps(names, "masks"):
        try:
            found.append({"mask": name, **_predicted(named_mask(asked.bench, name), square, views, asked.seeds)})
        except (InputError, ReconstructionError) as error:  # the others are still worth comparing
            found.append({"mask": name, "problem": str(error)})
    table = pd.DataFrame(found)
    if "light" not in table:
        raise InputError("; ".join(f"mask {each['mask']}: {each['problem']}" for each in found))
    table = table.sort_values(f"bound_{PEAKS_E[1]:.0f}_rad", ignore_index=True)
    return table, _figure(table.dropna(subset="light"))


def _pictures_of(names: Sequence[str]) -> Iterator[str]:
    """Yield names, and for a folder all pictures in it."""
    for name in names:
        if not Path(name).is_dir():
            yield name
            continue
        found = [str(each) for each in sorted(Path(name).iterdir()) if each.suffix.lower() in _PICTURES]
        if not found:
            raise InputError(f"the folder {name} holds no picture of a mask: NPY, PNG or TIFF")
        yield from found


def _predicted(bench: Bench, square: Image, views: Booleans, seeds: range) -> Row:
    """Light over the square's, hidden displacements, bound at each exposure, mean bias over the seeds, rad.

    The views are those inside the square, also where the mask is smaller: else small masks would seem better.
    """
    reference, em_camera = NoiseFreeFrames(bench).reference(), camera(bench)
    if not lit_views(bench).any():
        raise InputError("no view lies inside it")
    electrons = reference * np.float32(PEAKS_E[1] / square.max())
    reconstructor = em_camera.reconstructor(bench, electrons, WARP, reconstruction=without_prior(bench))
    counts = em_camera.counts(electrons)
    found = {"light": reference.sum() / square.sum(), "hidden": reconstructor.hidden}
    modes = reconstructor.register(counts).modes.count
    for peak_e in PEAKS_E:
        exposure = peak_e / PEAKS_E[1]
        bound = bound_rad(bench, reconstructor, field_modes=modes, views=views, exposure=exposure)
        found[f"bound_{peak_e:.0f}_rad"] = bound
    predict = linear_pass(bench, reconstructor, counts)
    for sample, changes in _SAMPLES.items():
        errors = []
        for screen in seeded(with_screen(bench, **changes), seeds):
            frames = NoiseFreeFrames(screen)
            wavefront = reconstructor.solve(predict(frames.sample))
            error = wavefront.views - frames.renderer.truth_wavefront(0)
            errors.append(mean_rms(np.where(wavefront.displacement.valid, error, np.nan)[views]))
        found[f"bias_{sample}_rad"] = np.mean(errors)
    return {name: float(value) for name, value in found.items()}


def _figure(table: pd.DataFrame) -> Figure:
    """Draw bound and bias against light, a panel for each exposure."""
    figure = Figure(figsize=(12.0, 4.2), layout="constrained")
    for peak_e, panel in zip(PEAKS_E, figure.subplots(1, len(PEAKS_E), sharex=True), strict=True):
        bound = table[f"bound_{peak_e:.0f}_rad"]
        for sample, marker in (("bench", "o"), ("source", "x")):
            error = np.hypot(bound, table[f"bias_{sample}_rad"])
            panel.plot(table["light"], error, marker, markersize=4, alpha=0.7, label=f"screen of the {sample}")
        panel.plot(table["light"], bound, "k_", markersize=6, label="bound alone")
        best = ", ".join(Path(name).name for name in table.loc[bound.nsmallest(3).index, "mask"])
        panel.set(title=f"{peak_e:g} e-\n{best}", yscale="log", xlabel="light over the square's")
        panel.grid(visible=True, which="both", linewidth=0.3)
    figure.axes[0].set_ylabel("error: bound and bias (rad)")
    figure.axes[0].legend(fontsize=7)
    return figure
