"""Verdicts on frames from image files: integer counts with a dark, whose noise is estimated from the images."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from app.bench.config import load_bench
from app.evaluation.frames import NoiseFreeFrames
from app.measurement.offline_reconstructor import OfflineReconstructor
from app.measurement.offline_reconstructor import reconstructor as reconstructor_of
from reconstruction.arrays import Image
from reconstruction.errors import ReconstructionError
from reconstruction.quality.verdict import Fault, Quality

SQUARE = ("simulation.source.mask=square",)
ELECTRONS, READ_NOISE, OFFSET = 4000.0, 5.0, 500.0  # in the brightest pixel; counts


@cache
def light() -> tuple[Image, Image]:
    """Reference and frame without noise, counts."""
    frames = NoiseFreeFrames(load_bench("small_demo", SQUARE))
    reference, frame = frames.reference("square"), frames.frame("square").photons
    scale = np.float32(ELECTRONS / reference.max())
    return reference * scale, frame * scale


def exposed(photons: NDArray[np.floating[Any]], seed: int) -> NDArray[np.uint16]:
    generator = np.random.default_rng(seed)
    counts = generator.poisson(photons) + generator.normal(OFFSET, READ_NOISE, photons.shape)
    return np.rint(counts).astype(np.uint16)


def dark() -> NDArray[np.uint16]:
    """Averaged: half of the unlit pixels of an image are below it."""
    return np.full(light()[0].shape, OFFSET, np.uint16)


def measured(frame: NDArray[np.uint16]) -> tuple[Quality, float]:
    """Verdict on a frame, and the median chi-square of its lenslets."""
    bench = load_bench("small_demo", SQUARE)
    reconstructor = reconstructor_of(bench, exposed(light()[0], 1), dark=dark(), frame=frame)
    wavefront = reconstructor(frame)
    displacement = wavefront.displacement
    return reconstructor.quality(frame, wavefront), float(np.median(displacement.chi_square[displacement.valid]))


@pytest.mark.slow
def test_right_integer_frame_is_explained_by_its_noise() -> None:
    quality, chi_square = measured(exposed(light()[1], 2))
    assert quality.faults == Fault(0), quality.sentence
    assert 0.8 < chi_square < 1.5


@pytest.mark.slow
def test_reference_as_frame_is_right() -> None:
    quality, _ = measured(exposed(light()[0], 3))
    assert quality.faults == Fault(0), quality.sentence


@pytest.mark.slow
@pytest.mark.parametrize("form", [np.uint16, np.float32])
def test_reference_itself_as_frame_is_flagged(form: type[np.number[Any]]) -> None:
    quality, _ = measured(exposed(light()[0], 1).astype(form))
    assert quality.faults == Fault.FROZEN
    assert "frame and reference are the same image" in quality.sentence


@pytest.mark.slow
@pytest.mark.long
def test_images_without_noise_leave_misfit_unjudged() -> None:
    """Their noise cannot be estimated, and blur or gamma would not be seen."""
    bench = load_bench("small_demo", SQUARE)
    reference, frame = (np.rint(image + OFFSET).astype(np.uint16) for image in light())
    for images, said in (
        ((reference, frame), "the noise of the images is unknown"),
        ((exposed(light()[0], 1), exposed(light()[1], 2)), ""),
    ):
        reconstructor = reconstructor_of(bench, images[0], dark=dark(), frame=images[1])
        quality = reconstructor.quality(images[1], reconstructor(images[1]))
        assert quality.unjudged.endswith(said)
        assert bool(quality.unjudged) == bool(said)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("process", ["filtered", "gamma"])
def test_fault_that_hides_the_noise_is_flagged(process: str) -> None:
    above = exposed(light()[1], 2) - OFFSET
    changed = ndimage.gaussian_filter(above, 1.5)
    if process == "gamma":
        changed = np.sqrt(np.maximum(above, 0) * above.max())
    quality, _ = measured(np.rint(changed + OFFSET).clip(0, 65535).astype(np.uint16))
    assert Fault.MISFIT in quality.faults


@pytest.mark.slow
def test_exchanged_frame_and_reference_are_flagged() -> None:
    reconstructor = OfflineReconstructor(load_bench("small_demo", SQUARE), exposed(light()[1], 1), dark=dark())
    frame = exposed(light()[0], 2)
    quality = reconstructor.quality(frame, reconstructor(frame))
    assert Fault.SAMPLE in quality.faults
    assert "or is it the frame?" in quality.sentence


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("images", ["frame", "reference", "both"])
def test_compressed_counts_are_flagged(images: str) -> None:
    """As of a saturating register."""
    full_well = float(light()[0].max())

    def compressed(counts: NDArray[np.uint16], image: str) -> NDArray[np.uint16]:
        if images not in {image, "both"}:
            return counts
        above = counts - OFFSET
        return np.asarray(np.rint(OFFSET + full_well * (1 - np.exp(-above / full_well))), np.uint16)

    reference, frame = compressed(exposed(light()[0], 1), "reference"), compressed(exposed(light()[1], 2), "frame")
    reconstructor = reconstructor_of(load_bench("small_demo", SQUARE), reference, dark=dark(), frame=frame)
    quality = reconstructor.quality(frame, reconstructor(frame))
    assert Fault.LINEARITY in quality.faults
    assert "too small" in quality.reasons[Fault.LINEARITY]


def gamma(counts: NDArray[np.uint16], power: float) -> NDArray[np.uint16]:
    above, full = np.maximum(counts - OFFSET, 0), float(light()[0].max())
    return np.asarray(np.rint(OFFSET + full * (above / full) ** power), np.uint16)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("power", [0.7, 1.4])
@pytest.mark.parametrize("image", ["frame", "reference"])
def test_gamma_in_one_image_is_flagged(image: str, power: float) -> None:
    reference, frame = exposed(light()[0], 1), exposed(light()[1], 2)
    if image == "frame":
        frame = gamma(frame, power)
    else:
        reference = gamma(reference, power)
    reconstructor = reconstructor_of(load_bench("small_demo", SQUARE), reference, dark=dark(), frame=frame)
    quality = reconstructor.quality(frame, reconstructor(frame))
    assert Fault.LINEARITY in quality.faults
    if power > 1:
        assert "not alike" in quality.reasons[Fault.LINEARITY]


@pytest.mark.slow
@pytest.mark.parametrize("averaged", [1, 16])
def test_uneven_pixels_and_a_dimmer_frame_are_no_gamma(averaged: int) -> None:
    uneven = 1 + 0.01 * np.random.default_rng(7).normal(size=light()[0].shape)
    images = [exposed(light()[0] * uneven, seed) for seed in range(10, 10 + averaged)]
    reference, frame = np.asarray(np.mean(images, axis=0), np.float32), exposed(0.5 * light()[1] * uneven, 2)
    reconstructor = reconstructor_of(load_bench("small_demo", SQUARE), reference, dark=dark(), frame=frame)
    quality = reconstructor.quality(frame, reconstructor(frame))
    assert quality.faults == Fault(0), quality.sentence


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_stray_light_that_rises_across_the_frame_is_flagged(axis: int) -> None:
    """By 1.5 % of the brightest from lenslet to lenslet."""
    lenslets = np.indices(light()[0].shape)[axis] / 31.25
    quality, _ = measured(exposed(light()[1] + np.float32(0.015 * ELECTRONS) * lenslets, 2))
    assert Fault.ILLUMINATION in quality.faults
    assert "stray light rises across the frame, by 1." in quality.sentence


@pytest.mark.slow
@pytest.mark.parametrize("change", ["the same everywhere", "half the light on one side"])
def test_even_stray_light_and_uneven_light_do_not_rise(change: str) -> None:
    frame = light()[1]
    fading = frame * np.linspace(1, 0.5, frame.shape[1])
    quality, _ = measured(exposed(frame + 0.15 * ELECTRONS if change == "the same everywhere" else fading, 2))
    assert "stray light" not in quality.sentence
    assert "not alike" not in quality.sentence


@pytest.mark.parametrize(("seed", "rms_rad"), [(4, 4.0)])
def test_moved_images_of_pinholes_are_no_change_of_light(seed: int, rms_rad: float) -> None:
    """A pinhole's image is a few pixels wide and moves by several."""
    methods = ("registration.method=centroids", "reconstruction.method=zonal")
    screen = (f"simulation.seed={seed}", f"simulation.screen.rms_rad={rms_rad}")
    bench = load_bench("small_demo", (*methods, *screen))
    frames = NoiseFreeFrames(bench)
    reference = frames.reference("stars")
    scale = np.float32(ELECTRONS / reference.max())
    frame = exposed(frames.frame("stars").photons * scale, 2)
    reconstructor = reconstructor_of(bench, exposed(reference * scale, 1), dark=dark(), frame=frame)
    quality = reconstructor.quality(frame, reconstructor(frame))
    assert quality.faults == Fault(0), quality.sentence


def test_black_frame_is_refused() -> None:
    with pytest.raises(ReconstructionError, match="is the light on"):
        measured(dark())


@pytest.mark.parametrize("counts", [3000, 65535])
def test_dark_with_more_light_than_the_reference_is_refused(counts: int) -> None:
    bright = np.full(light()[0].shape, counts, np.uint16)
    with pytest.raises(ReconstructionError, match="the reference shows no light above the dark"):
        OfflineReconstructor(load_bench("small_demo", SQUARE), exposed(light()[0], 1), dark=bright)(
            exposed(light()[1], 1)
        )
