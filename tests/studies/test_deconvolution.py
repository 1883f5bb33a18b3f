"""Corrected images against the truth: photographs in propagated light, by code that the estimator does not share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import svwfs
from app.evaluation.frames import NoiseFreeFrames
from reconstruction.arrays import Floats
from reconstruction.deconvolution.corrected_image import corrected_image
from reconstruction.deconvolution.imaging import Imaging
from studies.deconvolution import deconvolution, pupil_field
from studies.photograph import cells, photographs, true_psf
from studies.tables import Asked


@pytest.mark.slow
@pytest.mark.long
def test_measured_psfs_are_far_better_than_one_and_as_good_as_the_true_ones() -> None:
    bench = svwfs.load_bench("paper_simulation", "simulation.source.mask='checkerboard'")
    psnr_db = deconvolution(Asked(bench))[0].set_index("object")
    assert set(psnr_db.index) == {"target", "cells", "stars"}
    assert (psnr_db["measured PSFs"] > psnr_db["best single PSF"] + 3).all()
    assert (psnr_db["measured PSFs"] > psnr_db["photograph"] + 3).all()
    assert (psnr_db["measured PSFs"] > psnr_db["true PSFs"] - 0.5).all()


@pytest.mark.slow
@pytest.mark.long
def test_photograph_in_propagated_light_is_restored_only_the_right_way_round() -> None:
    """The screen lies near the mask: field positions see different parts of it, and light gathers on the way."""
    settings = ("screen.placement='source'", "screen.distance_m=0.06", "screen.correlation_length_m=0.6e-3")
    bench = svwfs.load_bench(
        "small_demo", *(f"simulation.{each}" for each in (*settings, "source.mask='checkerboard'", "screen.rms_rad=2"))
    )
    images = svwfs.simulate(bench)
    wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    sample, side, reach, pixel_m = NoiseFreeFrames(bench).sample, 120, 24, 12e-6
    scene = cells(side, np.random.default_rng(1)) * 2e3
    imaging = Imaging(pixel_m=pixel_m, counts_per_electron=1.0)

    def psf_at(x_px: float, y_px: float) -> Floats:
        x_m, y_m = imaging.field_m(np.array(x_px), np.array(y_px), scene.shape)
        return true_psf(
            pupil_field(sample, *np.clip([float(x_m), float(y_m)], -0.6e-3, 0.6e-3)),
            pixel_rad=pixel_m / bench.field.collimator_focal_length_m,
            wavelength_m=bench.sensor.wavelength_m,
            pupil_width_m=2 * min(bench.sensor.pupil_half_width_m),
            reach_px=reach,
        )

    photograph = photographs(scene[None], psf_at, spacing_px=8)[0]
    inner = slice(20, -20)

    def error(phase_at: Callable[[float, float], Floats] | None) -> float:
        image = photograph
        if phase_at is not None:
            made = corrected_image(
                photograph,
                phase_at,
                imaging,
                sensor=bench.sensor,
                field=bench.field,
                method="richardson-lucy",
                iterations=50,
            )
            image = made.image.astype(np.float64)
        return float(np.linalg.norm((image - scene)[inner, inner]))

    right, at = error(wavefront.at), wavefront.at
    assert right < 0.6 * error(None)
    wrong = {
        "sign": error(lambda x, y: -at(x, y)),
        "pupil mirrored": error(lambda x, y: at(x, y)[:, ::-1]),
        "pupil transposed": error(lambda x, y: at(x, y).T),
        "field mirrored": error(lambda x, y: at(-x, y)),
        "field transposed": error(lambda x, y: at(y, x)),
    }
    assert min(wrong.values()) > 1.5 * right, (right, wrong)
