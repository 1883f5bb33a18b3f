"""Accuracy of source masks, predicted before they are manufactured and beside a full simulation.

Without noise, the prediction is the response of one pass to the screens of the bench: the local wavefronts of the
screen over each lenslet change its image to first order, light that they gather included, and the registration turns
that change into a displacement. It includes what the warp and the modes cannot describe, but no error that grows with
the square of strong wavefronts. The noise follows from the Fisher information of the reference (the Cramer-Rao bound)
and from the estimator's own error bars.

In real light, the inside of a uniform area shows no displacement. A mask may hide some displacements of every lenslet:
then the bound is large, and only the layers of the sample determine the wavefront.

Many masks are compared by prediction alone: noise and bias of one pass against the light that each lets through. The
exposure is equal: it gives a plain square some electrons in the brightest pixel of its reference.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from app.bench.config import Bench
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, seeded, with_screen, with_source
from app.evaluation.studies import CaseResult, Printed, Study
from app.evaluation.study.estimators import camera, compared, mean_rms_within, warp_estimator, with_rms
from app.evaluation.study.noise_limit import bound_rad, error_bar_rad, scatter_of, true_lenslet, without_prior
from app.evaluation.study.sweeps import NEAR_SOURCE, lit_views
from app.evaluation.study_kinds import Sweep
from app.progress import Progress
from reconstruction.arrays import Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.pipeline import Reconstructor
from reconstruction.registration.response import WarpRegistration
from reconstruction.settings import Warp
from simulated_devices.optics.source import read_grey_image
from simulated_devices.sample import Sample
from simulated_devices.settings import MASKS, Source

PEAKS_E = (300.0, 1e3, 1e4)  # electrons in the brightest pixel of the reference
_SIMULATED_E = (300.0, 1e3)  # light of the simulated noise
_DRAWS = 40  # of simulated noise
WARP: Warp = "cubic"
_DEGREE = 5  # of the wavefronts over a lenslet, and over the field
_NODES = 8  # of Gauss-Legendre quadrature


def mask_study(masks: Sequence[str]) -> Sweep:
    """Return the study of some masks.

    They are names of built-in ones, checkerboards as `checkerboard:5`, or image files.

    Raises `InputError` if there is none, or if one is unknown or no image.
    """
    sources = mask_changes("mask", masks)
    return Sweep(
        name="mask",
        title=f"Masks in one pass, noise with the {WARP} warp",
        axis="mask (its light over the square's; displacements of each lenslet that it hides)",
        measure=partial(_measure, sources=sources),
    )


def mask_changes(study: str, masks: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the changes of the bench's source for the square and each mask; see `mask_study`."""
    if not masks:
        raise InputError(f"{study} needs image files or names after it: svwfs study {study} FILE..., or {_built_in()}")
    return {name: _changes(name) for name in dict.fromkeys(("square", *masks))}


def _changes(name: str) -> dict[str, Any]:
    if name in MASKS and name != "image":
        return {"mask": name}
    mask, _, cells = name.partition(":")
    if mask == "checkerboard" and cells.isdecimal():
        try:
            return {"mask": mask, "checker_cells": Source(checker_cells=int(cells)).checker_cells}
        except ValueError as error:  # too few, or too many to count
            raise InputError(f"mask {name}: {error}") from error
    if not Path(name).exists():
        raise InputError(f"there is no mask and no file {name}: give an image file, or {_built_in()}")
    try:
        read_grey_image(Path(name))
    except ValueError as error:
        raise InputError(f"mask: {error}") from error
    return {"mask": "image", "file": name}


def _built_in() -> str:
    return ", ".join(mask for mask in MASKS if mask != "image")


def _measure(
    bench: Bench, seeds: range, progress: Progress, *, sources: dict[str, dict[str, Any]]
) -> Iterator[CaseResult]:
    square = NoiseFreeFrames(bench).reference("square")
    for index, (name, changes) in enumerate(sources.items()):
        try:
            study = _MaskStudy(with_source(bench, **changes), square)
            at = f"{name} ({study.light:.2f}; {study.hidden})"
            progress(f"{name}, residual", index / len(sources))
            yield from study.residuals(seeds, at)
            progress(f"{name}, noise", (index + 0.5) / len(sources))
            if 0 in seeds:  # of one screen
                yield from study.noise(at)
        except (InputError, ReconstructionError) as error:
            raise InputError(f"mask {name}: {error}") from error


class _MaskStudy:
    """One mask on a bench; `square` is the reference with the square, (row, column), for the exposure."""

    def __init__(self, bench: Bench, square: Image) -> None:
        self._bench = bench
        self._views = lit_views(bench)
        if not self._views.any():
            raise InputError("no view lies inside it: check [field] view_spacing_m")
        self._reference = NoiseFreeFrames(bench).reference()
        self._square_peak = float(square.max())
        self._reconstructor = warp_estimator(bench, self._reference, None).reconstructor
        self.hidden = self._reconstructor.hidden
        self.light = float(self._reference.sum() / square.sum())  # relative to the square

    def residuals(self, seeds: range, at: str) -> Iterator[CaseResult]:
        """Yield the residuals, rad, of one noise-free pass for each screen: predicted and simulated.

        They are those without assumption, and over the layers found; `at` names the mask on the axis.
        """
        reconstructor = self._reconstructor
        predict = LinearPass(self._bench, reconstructor, self._reference)
        for screen in seeded(self._bench, seeds):
            frames = NoiseFreeFrames(screen)
            frame = frames.frame()
            found = {"predicted": predict(frames.sample), "simulated": reconstructor.register(frame.photons)}
            for way, displacement in found.items():
                samples = {"any wavefront": FREE, "layers": reconstructor.find_sample(displacement)}
                for assumed, sample in samples.items():
                    wavefront = reconstructor.solve(displacement, sample=sample)
                    yield compared(
                        wavefront, frame.truth, curve=f"residual, {assumed}: {way}", at=at, views=self._views
                    )

    def noise(self, at: str) -> Iterator[CaseResult]:
        """Yield the noise, rad, of 45 modes with the bench's screen, at equal peak, and at equal exposure."""
        frame = NoiseFreeFrames(self._bench).frame().photons
        for label, own_peak in (("", float(self._reference.max())), (" in the square", self._square_peak)):
            for peak_e in PEAKS_E:
                scale = np.float32(peak_e / own_peak)
                yield from self._noise(at, f"noise, {peak_e:g} e-{label}", frame * scale, scale, peak_e)

    def _noise(
        self, at: str, curve: str, electrons: Image, electrons_per_photon: np.float32, peak_e: float
    ) -> Iterator[CaseResult]:
        """Yield bound, error bar and scatter, rad, for a frame (row, column) of electrons."""
        em_camera, reference_e = camera(self._bench), self._reference * electrons_per_photon
        reconstructor = em_camera.reconstructor(
            self._bench, reference_e, WARP, reconstruction=without_prior(self._bench)
        )
        without = reconstructor(em_camera.counts(electrons))
        modes = without.displacement.modes.count
        bound = bound_rad(self._bench, reconstructor, field_modes=modes, views=self._views)
        yield with_rms(without, bound, curve=f"{curve}: bound", at=at)
        yield with_rms(without, error_bar_rad(without, self._views), curve=f"{curve}: predicted", at=at)
        if peak_e in _SIMULATED_E:
            seed = self._bench.simulation.seed
            draws = (reconstructor(em_camera.exposed(electrons, seed, draw)) for draw in range(_DRAWS))
            simulated = scatter_of(draws, without.views, self._views)
            yield with_rms(without, simulated.rms_rad, curve=f"{curve}: simulated", at=at)


class LinearPass:
    """One pass of a reconstruction for screens without noise, to first order in their wavefronts."""

    def __init__(self, bench: Bench, reconstructor: Reconstructor, reference: Image) -> None:
        """Take the reference (row, column) above the dark, in the unit of the frames."""
        self._bench = bench
        self._at_rest = reconstructor.register(reference)
        registration = reconstructor.registration_for(reference)
        if not isinstance(registration, WarpRegistration):
            raise TypeError("only a registration that fits warps has a response")
        model = true_lenslet(bench, reconstructor.subimages.width)
        self._modes = LegendreModes((_DEGREE + 1) * (_DEGREE + 2) // 2)
        x, y = model.position.T
        derivatives = model.derivatives(_DEGREE, self._modes.values(x, y), self._modes.gradients(x, y))
        self._response = registration.response(model.image(), derivatives) @ registration.parameters

    def __call__(self, sample: Sample) -> Displacement:
        """Return the displacement found for a sample."""
        local = local_screen(sample, self._bench, self._modes)
        displacement = np.einsum("lnmqk,lnmq->lk", self._response, local, optimize=True)
        shape = self._at_rest.coefficients.shape
        displacement = np.swapaxes(displacement.reshape(*shape[:2], 2, -1), 2, 3)
        return replace(self._at_rest, coefficients=self._at_rest.coefficients + displacement)


def local_screen(sample: Sample, bench: Bench, modes: LegendreModes) -> Floats:
    """Return the light's phase over each lenslet, rad, (lenslet, n, m, field_mode).

    It is that of wavefronts P_m(xi) P_n(eta) T_q, and 0 beyond degree 5. The projection is exact up to rounding for
    screens that are polynomials of that degree.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    project = np.polynomial.legendre.legvander(nodes, _DEGREE) * weights[:, None] * (np.arange(_DEGREE + 1) + 0.5)
    light, rays, sensor, half_m = sample.light, sample.light.ray_map, bench.sensor, bench.sensor.lenslet_pitch_m / 2

    def along(center_m: Floats) -> Floats:
        """Positions in the light's plane, (lenslet, pupil node, field node)."""
        u_m = center_m[:, None, None] + half_m * nodes[:, None]
        return np.asarray(rays.pupil_scale * u_m + rays.field_scale * bench.field.half_width_m * nodes)

    x_m, y_m = along(sensor.pupil_x_m), along(sensor.pupil_y_m)
    along_y, along_x = light.phase.basis(y_m.ravel(), 0), light.phase.basis(x_m.ravel(), 1)
    phase = np.asarray(along_y @ light.phase.coefficients @ along_x.T).reshape(*y_m.shape, *x_m.shape)
    series = np.einsum("rjvcih,jn,im,vb,ha->rcnmba", phase, project, project, project, project, optimize=True)
    local = np.einsum("rcnmba,qba->rcnmq", series, modes.products)
    n, m = np.indices(local.shape[2:4])
    local[:, :, n + m > _DEGREE] = 0
    return np.asarray(local.reshape(-1, *local.shape[2:]))


_SAMPLES: dict[str, dict[str, Any]] = {"bench": {}, "source": NEAR_SOURCE | {"rms_rad": 2.0}}  # changes of the screen
_BOUNDS = {peak_e: f"bound_{peak_e:.0f}_rad" for peak_e in PEAKS_E}
_BIASES = {sample: f"bias_{sample}_rad" for sample in _SAMPLES}
_PICTURES = (".npy", ".png", ".tif", ".tiff")


def many_masks_study(names: Sequence[str]) -> "MaskComparison":
    """Return the comparison of masks named as for `mask_study`; a folder stands for all pictures in it.

    Raises `InputError` if there is none, or if one is unknown or no image.
    """
    files: list[str] = []
    for name in names:
        inside = sorted(Path(name).iterdir()) if Path(name).is_dir() else ()
        found = [str(each) for each in inside if each.suffix.lower() in _PICTURES]
        if Path(name).is_dir() and not found:
            raise InputError(f"the folder {name} holds no picture of a mask: NPY, PNG or TIFF")
        files += found or [name]
    return MaskComparison(
        name="masks",
        title=f"Masks in one pass with the {WARP} warp, predicted",
        measure=partial(_measure_masks, sources=mask_changes("masks", files)),
    )


def _measure_masks(
    bench: Bench, seeds: range, progress: Progress, *, sources: Mapping[str, dict[str, Any]]
) -> Iterator[CaseResult]:
    square, views = NoiseFreeFrames(bench).reference("square"), lit_views(with_source(bench, mask="square"))
    for index, (name, changes) in enumerate(sources.items()):
        progress(name, index / len(sources))
        at, problem, values = {"mask": name}, "", {}
        try:
            values = _predicted(with_source(bench, **changes), square, views, seeds)
        except (InputError, ReconstructionError) as error:  # the others are still worth comparing
            problem = str(error)
        yield CaseResult(at=at, values=values, problem=problem)


def _predicted(bench: Bench, square: Image, views: NDArray[np.bool_], seeds: range) -> dict[str, float]:
    """Light over the square's, hidden displacements, bound at each exposure, mean bias over the seeds.

    The views are those inside the square, also where the mask is smaller: else small masks would seem better.
    """
    reference, seen = NoiseFreeFrames(bench).reference(), camera(bench)
    if not lit_views(bench).any():
        raise InputError("no view lies inside it")
    electrons = reference * np.float32(PEAKS_E[1] / square.max())
    reconstructor = seen.reconstructor(bench, electrons, WARP, reconstruction=without_prior(bench))
    counts = seen.counts(electrons)
    light, peak = float(reference.sum() / square.sum()), float(reference.max() / square.max())
    values = {"light": light, "peak": peak, "hidden": float(reconstructor.hidden)}
    modes = reconstructor.register(counts).modes.count
    for peak_e, bound in _BOUNDS.items():
        exposure = peak_e / PEAKS_E[1]
        values[bound] = bound_rad(bench, reconstructor, field_modes=modes, views=views, exposure=exposure)
    predict = LinearPass(bench, reconstructor, counts)
    for sample, changes in _SAMPLES.items():
        errors = []
        for screen in seeded(with_screen(bench, **changes), seeds):
            frames = NoiseFreeFrames(screen)
            wavefront = reconstructor.solve(predict(frames.sample))
            error = wavefront.views - frames.renderer.truth_wavefront(0)
            errors.append(mean_rms_within(error, wavefront.displacement.valid, views))
        values[_BIASES[sample]] = float(np.mean(errors))
    return values


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskComparison(Study):
    """Predictions for many masks, sorted by the bound at the middle exposure."""

    dims: ClassVar = ("mask",)
    key: ClassVar = "masks"

    def summary(self, data: pd.DataFrame) -> pd.DataFrame:
        """Return a row for each mask that could be predicted: means over the seeds, the best first."""
        means = data.groupby("mask", observed=True).mean(numeric_only=True)
        if "light" not in means:
            raise InputError("; ".join(f"mask {row.mask}: {row.problem}" for row in data.itertuples()))
        return means.dropna(subset="light").sort_values(_BOUNDS[PEAKS_E[1]]).reset_index()

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return a line for each mask, the best first."""
        numbers = [*_BOUNDS.values(), *_BIASES.values()]
        lines = [
            [str(row["mask"]), f"{row['light']:.2f}", f"{row['hidden']:.0f}", *(f"{row[each]:.4f}" for each in numbers)]
            for row in self.summary(data).to_dict("records")
        ]
        headings = ("mask", "light", "hides", *(f"bound, {peak_e:g} e-" for peak_e in PEAKS_E))
        notes = ["rad; equal exposure; light over the square's; displacements of each lenslet that it hides"]
        notes += [f"{row.mask}: {row.problem}" for row in data.itertuples() if row.problem]
        return Printed(self.title, (*headings, "bias, bench's screen", "bias, near the source"), lines, notes)

    def figure(self, data: pd.DataFrame) -> Figure:
        """Draw bound and bias against light, a panel for each exposure, with the names of the best three."""
        masks = self.summary(data)
        figure = Figure(figsize=(12.0, 4.2), layout="constrained")
        panels = figure.subplots(1, len(PEAKS_E), sharex=True)
        for peak_e, panel in zip(PEAKS_E, panels, strict=True):
            bound = masks[_BOUNDS[peak_e]]
            for sample, marker in (("bench", "o"), ("source", "x")):
                error = np.hypot(bound, masks[_BIASES[sample]])
                label = "bench's screen" if sample == "bench" else "near the source"
                panel.plot(masks["light"], error, marker, markersize=4, alpha=0.7, label=label)
            panel.plot(masks["light"], bound, "k_", markersize=6, label="bound alone")
            best = masks.assign(bound=bound).nsmallest(3, "bound")
            names = []
            for rank, row in enumerate(best.itertuples(), 1):
                at = (row.light, row.bound)
                panel.annotate(f"{rank}", at, (0, -9), textcoords="offset points", fontsize=7, ha="center")
                names.append(f"{rank}  {Path(str(row.mask)).name}")
            panel.set(title=f"{peak_e:g} e-", yscale="log", ymargin=0.12)
            panel.set_xlabel("\n".join(["light over the square's", *names]), fontsize=8)
            panel.grid(visible=True, which="both", linewidth=0.3)
        panels[0].set_ylabel("error: bound and bias (rad)")
        panels[0].legend(fontsize=7)
        figure.suptitle(self.title, fontsize=10)
        return figure
