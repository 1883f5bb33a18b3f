"""Corrected images next to the truth: photographs through a screen near the sample, restored."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from app.bench.config import Bench
from app.evaluation.frames import NoiseFreeFrames, seeded, simulate, with_screen
from app.measurement.offline_reconstructor import OfflineReconstructor
from reconstruction.arrays import Floats
from reconstruction.deconvolution.corrected_image import PhaseAt, corrected_image, psf_reach_px
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from simulated_devices.sample import Sample
from studies.photograph import PupilField, cells, photographs, resolution_target, star_field, true_psf
from studies.tables import Asked, Made, Row, steps

# 20 mm behind the mask, so that the point-spread functions of the field have little in common
_SCREEN: dict[str, Any] = {
    "placement": "source",
    "distance_m": 0.02,
    "correlation_length_m": 0.6e-3,
    "rms_rad": 3.0,
    "samples": 481,
    "sample_spacing_m": 5e-6,
}
_RESOLUTION_PX = 2.5  # 2 pixels just sample the optical resolution
_MARGIN_PX = 20  # of the image around the field
_NODES_PX = 8  # between true point-spread functions
_PEAK_E = {"target": 2e3, "cells": 2e3, "stars": 4e4}  # of the object
_ITERATIONS = 60
_WIDER_PX = 10  # reach of the true point-spread functions beyond that of ours


def deconvolution(asked: Asked) -> Made:
    """Peak signal-to-noise ratio within the field (dB) of photographs restored in several ways."""
    bench = with_screen(asked.bench, **_SCREEN)
    bench = replace(bench, registration=RegistrationSettings(), reconstruction=ReconstructionSettings())
    screens = steps(seeded(bench, asked.seeds), "photographs")
    data = pd.DataFrame([each for screen in screens for each in _Photographs(screen).results()])
    means = data.pivot_table("psnr_db", "object", "way", sort=False, dropna=False)
    return means.dropna(axis="columns").reset_index(), _figure(data, means)


def _figure(data: pd.DataFrame, means: pd.DataFrame) -> Figure:
    """Draw the first repeat with a gamma of 1/2, a row per object, a column per way."""
    figure = Figure(figsize=(2.4 * means.shape[1], 2.65 * means.shape[0]), layout="constrained")
    first = data.drop_duplicates(["object", "way"])
    axes = figure.subplots(*means.shape, squeeze=False)
    for axis, way, mean_db, image in zip(axes.flat, first["way"], means.to_numpy().flat, first["image"], strict=True):
        axis.imshow(np.sqrt(np.clip(image, 0, 1)), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axis.set_title(f"{way}, {mean_db:.1f} dB" if np.isfinite(mean_db) else way, fontsize=8)
        axis.set_axis_off()
    return figure


class _Photographs:
    """Photographs through the screen of one bench, and the ways to restore them."""

    def __init__(self, bench: Bench) -> None:
        self._bench, self._sample = bench, NoiseFreeFrames(bench).sample
        frames = simulate(bench)
        self._measured = OfflineReconstructor(bench, frames.reference, dark=frames.dark)(frames.frames[0])
        unit = Imaging(pixel_m=1e-6, counts_per_electron=1.0)
        pixel_m = unit.pixel_m * unit.blur_px(bench.sensor, bench.field) / _RESOLUTION_PX
        self._imaging = replace(unit, pixel_m=pixel_m)
        self._side = 2 * (round(bench.field.half_width_m / pixel_m) + _MARGIN_PX)

    def results(self) -> Iterator[Row]:
        """Yield `object`, `way`, `psnr_db`, and `image` (row, column) over the object's peak."""
        generator, side = np.random.default_rng(self._bench.simulation.seed), self._side
        objects = {
            "target": resolution_target(side),
            "cells": cells(side, generator),
            "stars": star_field(side, generator),
        }
        truths = np.stack([objects[name] * _PEAK_E[name] for name in objects])
        for name, truth, mean in zip(objects, truths, self._photographed(truths), strict=True):
            photograph = generator.poisson(mean).astype(np.float64)
            for way, image in self._restored(photograph, truth):
                psnr_db = np.nan if way == "object" else self._psnr_db(image, truth)
                yield {"object": name, "way": way, "psnr_db": psnr_db, "image": image / truth.max()}

    def _restored(self, photograph: Floats, truth: Floats) -> Iterator[tuple[str, Floats]]:
        """Yield each way and its image, electrons, as photograph and truth: (row, column)."""
        yield "object", truth
        yield "photograph", photograph
        field = self._bench.field
        singles = [
            self._correct(photograph, _constant(self._measured.at(float(x_m), float(y_m))))
            for y_m, x_m in product(field.view_y_m, field.view_x_m)
        ]
        yield "best single PSF", max(singles, key=lambda image: self._psnr_db(image, truth))
        yield "measured PSFs", self._correct(photograph, self._measured.at)
        yield "measured PSFs, Wiener", self._correct(photograph, self._measured.at, is_wiener=True)
        yield "true PSFs", self._correct(photograph, self._true_phase)

    def _correct(self, photograph: Floats, phase_at: PhaseAt, *, is_wiener: bool = False) -> Floats:
        """Correct a photograph (row, column), electrons, by the wavefront of each field position."""
        made = corrected_image(
            photograph,
            phase_at,
            self._imaging,
            sensor=self._bench.sensor,
            field=self._bench.field,
            method="wiener" if is_wiener else "richardson-lucy",
            iterations=_ITERATIONS,
        )
        return made.image.astype(np.float64)

    def _psnr_db(self, image: Floats, truth: Floats) -> float:
        """Peak signal-to-noise ratio within the field of an image (row, column), electrons."""
        inside = self._imaging.inside(truth.shape, self._bench.field)
        return float(10 * np.log10(truth.max() ** 2 / np.mean((image - truth)[inside] ** 2)))

    def _photographed(self, truths: Floats) -> Floats:
        """Mean electrons of photographs of objects (object, row, column), electrons."""
        bench = self._bench
        reach = psf_reach_px(self._imaging, bench.sensor, bench.field, self._measured.views) + _WIDER_PX

        def psf_at(x_px: float, y_px: float) -> Floats:
            """Point-spread function (row, column), sum 1, at a pixel."""
            x_m, y_m = self._imaging.field_m(np.array(x_px), np.array(y_px), truths.shape[1:])
            return true_psf(
                pupil_field(self._sample, float(x_m), float(y_m)),
                pixel_rad=self._imaging.pixel_m / bench.field.collimator_focal_length_m,
                wavelength_m=bench.sensor.wavelength_m,
                pupil_width_m=2 * min(bench.sensor.pupil_half_width_m),
                reach_px=reach,
            )

        return photographs(truths, psf_at, spacing_px=_NODES_PX)

    def _true_phase(self, x_m: float, y_m: float) -> Floats:
        """Phase of the screen, rad, (lenslet_row, lenslet_column), at a field position."""
        light, sensor = self._sample.light, self._bench.sensor
        u_m, v_m = np.moveaxis(sensor.lenslet_centers_m, -1, 0)
        scale, ratio = light.ray_map.pupil_scale, light.ray_map.field_scale
        return light.phase.at(scale * u_m + ratio * x_m, scale * v_m + ratio * y_m)


def pupil_field(sample: Sample, x_m: float, y_m: float) -> PupilField:
    """Return the light of a field position at the lenslets, as a function of their position (m)."""
    light = sample.light
    scale, from_x_m, from_y_m = light.ray_map.pupil_scale, *(light.ray_map.field_scale * at_m for at_m in (x_m, y_m))
    return lambda u_m, v_m: light.column(scale * u_m + from_x_m)(scale * v_m + from_y_m)


def _constant(phase: Floats) -> PhaseAt:
    """Take a wavefront (lenslet_row, lenslet_column), rad, for that of the whole field."""
    return lambda _x_m, _y_m: phase
