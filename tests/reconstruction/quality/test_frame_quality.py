"""Verdicts on frames: honest ones of all warps and light levels, and impossible ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from faulty_frames import FAULTY
from numpy.typing import NDArray
from support.optics import FIELD, SmallBench, converged

from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.frame.pixels import KnownCamera
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.quality.frame_quality import QualityChecker
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.reconstructor import Reconstructor
from reconstruction.settings import Warp
from simulated_devices.optics.source import stars
from simulated_devices.settings import Source

Light = NDArray[np.float32]

READ_NOISE_E = 8.0
BENCH = SmallBench()
WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic", "quartic")
NOISE = CameraNoise(counts_per_electron=1.0, read_noise_counts=READ_NOISE_E)


@cache
def star_bench() -> SmallBench:
    """A bench with the paper's pinholes."""
    bench = SmallBench()
    bench.source = stars(Source())
    bench.reference = bench.model.irradiance(bench.source) * np.float32(1e14)
    return bench


@cache
def aberrated(strength: float, bench: SmallBench = BENCH) -> Light:
    """Electrons per brightest electron of the reference, in real light behind a wavefront of two layers."""
    half_m, half_field_m = bench.sensor.pupil_half_width_m[0], FIELD.half_width_m
    u, v = (axis / half_m for axis in bench.samples())
    gathered = FIELD.collimator_focal_length_m / bench.sensor.wavenumber_rad_per_m / half_m / half_field_m

    def layer(s: Floats, t: Floats) -> Floats:
        return np.asarray(np.sin(2.5 * s + 1) * np.cos(2.1 * t) + 0.7 * np.sin(1.8 * s - 2.6 * t))

    def curvature(s: Floats, t: Floats) -> Floats:
        """Second derivatives along s, along t, and along both."""
        wave, turned = np.sin(2.5 * s + 1) * np.cos(2.1 * t), np.cos(2.5 * s + 1) * np.sin(2.1 * t)
        slanted = 0.7 * np.sin(1.8 * s - 2.6 * t)
        return np.stack(
            [
                -(2.5**2) * wave - 1.8**2 * slanted,
                -(2.1**2) * wave - 2.6**2 * slanted,
                -2.5 * 2.1 * turned + 1.8 * 2.6 * slanted,
            ]
        )

    def phase(x_m: float, y_m: float) -> Light:
        x, y = x_m / half_field_m, y_m / half_field_m
        near, far = layer(u - 0.05 * x, v - 0.05 * y), layer(v - 0.2 * y, u - 0.2 * x)
        return np.asarray(strength * (near + far), np.float32)

    def amplitude(x_m: float, y_m: float) -> Light:
        x, y = x_m / half_field_m, y_m / half_field_m
        near, far = curvature(u - 0.05 * x, v - 0.05 * y), curvature(v - 0.2 * y, u - 0.2 * x)
        along_u, along_v, mixed = -strength * gathered * (0.05 * near + 0.2 * far[[1, 0, 2]])
        return np.asarray(np.sqrt((1 + along_u) * (1 + along_v) - mixed**2), np.float32)

    return bench.frame(phase, amplitude) / np.float32(bench.reference.max())


def exposed(light: Light, peak_e: float, seed: int) -> Light:
    rng = np.random.default_rng(seed)
    counts = rng.poisson(np.maximum(light, 0) * peak_e) + rng.normal(0, READ_NOISE_E, light.shape)
    return np.asarray(counts, np.float32)


@cache
def measured_by(warp: Warp, peak_e: float, bench: SmallBench = BENCH) -> tuple[Reconstructor, QualityChecker]:
    reference = np.asarray(bench.reference / bench.reference.max() * peak_e, np.float32)
    dark = np.zeros_like(reference)
    camera = KnownCamera(dark, noise=KnownNoise(NOISE))
    reconstructor = bench.reconstructor(warp, pupil_modes=None, reference=reference, camera=camera)
    quality_checker = QualityChecker(reconstructor.subimages, reconstructor.registration, camera=camera)
    return reconstructor, quality_checker


def faults(warp: Warp, peak_e: float, light: Light, bench: SmallBench = BENCH) -> tuple[Fault, str]:
    """Faults with their reasons; a refusal because subimages look different counts as a misfit."""
    try:
        found = verdict(warp, peak_e, light, bench=bench)
    except ReconstructionError as error:
        return (Fault.MISFIT if "look different" in str(error) else Fault(0)), str(error)
    return found.faults, found.sentence


def verdict(warp: Warp, peak_e: float, light: Light, seed: int = 0, bench: SmallBench = BENCH) -> Quality:
    reconstructor, quality_checker = measured_by(warp, peak_e, bench)
    frame = exposed(light, peak_e, seed)
    return quality_checker(frame, reconstructor.register(frame))


@pytest.mark.slow
@pytest.mark.parametrize("peak_e", [200.0, 1e3, 1e4, 1e5])
@pytest.mark.parametrize("warp", WARPS)
def test_honest_frames_raise_no_alarm(warp: Warp, peak_e: float) -> None:
    for seed, strength in enumerate((0.0, 0.5, 2.0, 4.0)):
        found = verdict(warp, peak_e, aberrated(strength), seed)
        assert not found.reasons, (strength, found.sentence)


@pytest.mark.parametrize(("rows", "columns"), [(3, 3), (4, 4), (2, 7)])
def test_slopes_of_few_lenslets_are_not_judged(rows: int, columns: int) -> None:
    """They sample a smooth wavefront too coarsely."""
    bench = SmallBench(rows, columns)
    found = verdict("quadratic", 1e4, aberrated(2.0, bench), bench=bench)
    assert Fault.SLOPES not in found.faults
    assert "slopes are not checked: the lattice has too few lenslets" in found.unjudged


@pytest.mark.slow
@pytest.mark.parametrize(("warp", "enough"), [("quadratic", 2), ("quartic", 7)])
def test_slopes_against_a_noisy_reference_are_not_judged(warp: Warp, enough: int) -> None:
    """Noise of the reference distorts the displacements, far more than its variance tells: that is no torn frame."""
    peak_e, light = 250.0, np.asarray(BENCH.reference / BENCH.reference.max(), np.float32)
    for averaged in (1, enough):
        reference = np.mean([exposed(light, peak_e, 100 + index) for index in range(averaged)], axis=0)
        camera = KnownCamera(np.zeros_like(reference), noise=KnownNoise(NOISE, averaged))
        reconstructor = BENCH.reconstructor(warp, pupil_modes=None, reference=reference, camera=camera)
        quality_checker = QualityChecker(reconstructor.subimages, reconstructor.registration, camera=camera)
        for seed, strength in enumerate((0.5, 2.0, 4.0)):
            frame = exposed(aberrated(strength), peak_e, seed)
            found = quality_checker(frame, reconstructor.register(frame))
            assert Fault.SLOPES not in found.faults, (averaged, strength, found.sentence)
            assert (f"average at least {enough} frames" in found.unjudged) == (averaged == 1)


@pytest.mark.parametrize("peak_e", [1e3, 1e4])
@pytest.mark.parametrize("name", FAULTY)
def test_impossible_frame_is_found(name: str, peak_e: float) -> None:
    spoil, fault = FAULTY[name]
    for warp in ("quadratic", "cubic"):
        found, why = faults(warp, peak_e, spoil(aberrated(1.0), BENCH.lattice))
        assert fault in found, (warp, why)


@pytest.mark.parametrize("warp", WARPS)
def test_stars_may_blur(warp: Warp) -> None:
    """A wavefront changes the shape of a point's image, which no warp describes."""
    for seed, strength in enumerate((0.5, 1.0, 2.0, 4.0)):
        found = verdict(warp, 1e4, aberrated(strength, star_bench()), seed, star_bench())
        assert not found.reasons, (strength, found.sentence)


@pytest.mark.parametrize("name", FAULTY)
def test_impossible_frame_of_stars_is_found(name: str) -> None:
    spoil, fault = FAULTY[name]
    right = aberrated(1.0, star_bench())
    found, why = faults("cubic", 1e4, spoil(right, BENCH.lattice), star_bench())
    assert found & (fault | Fault.MISFIT), why


def test_torn_frame_is_found() -> None:
    torn, right = aberrated(0.0).copy(), aberrated(1.0)
    torn[: len(torn) // 2] = right[: len(right) // 2]
    assert verdict("cubic", 1e3, torn).faults == Fault.SLOPES


def test_other_mask_is_found() -> None:
    """Stars instead of the square."""
    stars = np.array(aberrated(0.0))
    row, column = np.indices(stars.shape)
    position = BENCH.lattice.from_camera_px(np.stack([column, row], axis=-1).astype(np.float64))
    stars[(np.abs(position % (BENCH.lattice.pitch_px / 3) - BENCH.lattice.pitch_px / 6) > 2).any(axis=-1)] = 0
    found, why = faults("cubic", 1e4, stars)
    assert Fault.MISFIT in found
    assert "check the mask" in why


def test_uneven_dimming_is_found_but_even_dimming_is_not() -> None:
    light = aberrated(1.0)
    assert not verdict("cubic", 1e4, 0.4 * light).reasons
    uneven = light.copy()
    uneven[:, : light.shape[1] // 3] *= 0.3
    assert verdict("cubic", 1e4, uneven).faults == Fault.ILLUMINATION


def test_spot_of_stray_light_is_found() -> None:
    """A third of the brightest pixels, as wide as a lenslet."""
    light = aberrated(1.0)
    row, column = np.indices(light.shape)
    spot = 0.3 * np.exp(-((row - 90) ** 2 + (column - 110) ** 2) / (2 * 30.0**2)).astype(np.float32)
    found = verdict("cubic", 1e4, light + spot)
    assert "stray light rises across the frame" in found.reasons[Fault.ILLUMINATION]


@pytest.mark.parametrize("form", ["<u2", ">u2", "i4", "i8", "f4", "g"])
def test_light_is_judged_without_a_dark_in_each_form(form: str) -> None:
    light, offset = aberrated(1.0), 400.0
    reference = np.rint(BENCH.reference / BENCH.reference.max() * 2e4 + offset).astype(form)
    reconstructor = BENCH.reconstructor("cubic", pupil_modes=None, reference=reference, noise=NOISE)
    quality_checker = QualityChecker(reconstructor.subimages, reconstructor.registration)
    uneven = light.copy()
    uneven[:, : light.shape[1] // 3] *= 0.3
    for image, faults in ((light, Fault(0)), (uneven, Fault.ILLUMINATION)):
        frame = np.rint(exposed(image, 2e4, 0) + offset).astype(form)
        assert quality_checker(frame, reconstructor.register(frame)).faults == faults


def test_dim_floating_point_images_are_judged_as_bright_ones() -> None:
    """An image with a sum of 1."""
    reference = np.asarray(BENCH.reference / BENCH.reference.sum(), np.float32)
    camera = KnownCamera(np.zeros_like(reference))
    reconstructor = BENCH.reconstructor("cubic", pupil_modes=None, reference=reference, camera=camera)
    quality_checker = QualityChecker(reconstructor.subimages, reconstructor.registration)
    frame = np.asarray(aberrated(1.0) / aberrated(1.0).sum() / 2, np.float32)
    assert not quality_checker(frame, reconstructor.register(frame)).reasons


@pytest.mark.parametrize(("share", "is_found"), [(0.011, False), (0.009, True), (1e-3, True), (1e-4, True)])
def test_light_far_below_the_reference_is_found(share: float, is_found: bool) -> None:
    """Also where so little noise remains that every lenslet matches."""
    reconstructor, quality_checker = measured_by("cubic", 1e5)
    frame = np.asarray(share * 1e5 * aberrated(0.0), np.float32)
    displacement = reconstructor.register(frame)
    assert displacement.valid.all()
    found = quality_checker(frame, displacement)
    assert (Fault.ILLUMINATION in found.faults) == is_found
    if is_found:
        assert f"only {100 * share:.2g} % of the reference's light" in found.reasons[Fault.ILLUMINATION]


def with_outcomes(outcome: LensletStatus, count: int) -> Fault:
    """Faults of a right frame of which so many lenslets have another outcome."""
    reconstructor, quality_checker = measured_by("cubic", 1e4)
    frame = exposed(aberrated(1.0), 1e4, 0)
    displacement = reconstructor.register(frame)
    outcomes = displacement.outcome.copy()
    outcomes.ravel()[:count] = outcome
    return quality_checker(frame, replace(displacement, outcome=outcomes)).faults


@pytest.mark.parametrize(
    ("outcome", "most", "fault"),
    [
        (LensletStatus.DIVERGED, 15, Fault.MISFIT),
        (LensletStatus.LEFT_CELL, 6, Fault.RANGE),
        (LensletStatus.DARK, 6, Fault.ILLUMINATION),
    ],
)
def test_lost_lenslets_up_to_a_share_pass(outcome: LensletStatus, most: int, fault: Fault) -> None:
    """A quarter or a tenth of 63."""
    assert with_outcomes(outcome, most) == Fault(0)
    assert with_outcomes(outcome, most + 1) == fault


@pytest.mark.parametrize(("factor", "is_found"), [(0.55, False), (0.42, True)])
def test_light_of_a_tenth_of_the_lenslets_may_differ_by_a_factor_of_2(factor: float, is_found: bool) -> None:
    light, pitch_px = aberrated(0.0).copy(), BENCH.lattice.pitch_px
    light[:, : int(BENCH.lattice.center_x_px - 3.5 * pitch_px)] *= factor  # one of nine columns
    assert verdict("cubic", 1e4, light).faults == (Fault.ILLUMINATION if is_found else Fault(0))


@pytest.mark.parametrize("is_in_reference", [True, False])
def test_stray_light_counts_only_if_the_reference_has_none(is_in_reference: bool) -> None:
    light = BENCH.reference / BENCH.reference.max() * 1e4
    rising = np.asarray(light + 1e4 * 0.02 / BENCH.lattice.pitch_px * np.arange(light.shape[1]), np.float32)
    reference = rising if is_in_reference else np.asarray(light, np.float32)
    camera = KnownCamera(np.zeros_like(reference), noise=KnownNoise(NOISE))
    reconstructor = BENCH.reconstructor("quadratic", pupil_modes=None, reference=reference, camera=camera)
    quality_checker = QualityChecker(reconstructor.subimages, reconstructor.registration, camera=camera)
    found = quality_checker(rising, reconstructor.register(rising))
    assert ("stray light rises across the frame" in found.sentence) != is_in_reference


@pytest.mark.parametrize(("share", "is_found"), [(0.0095, False), (0.0105, True)])
def test_one_percent_of_the_pixels_may_be_clipped(share: float, is_found: bool) -> None:
    reconstructor, quality_checker = measured_by("cubic", 1e4)
    frame = exposed(aberrated(0.0), 1e4, 0)
    displacement = reconstructor.register(frame)
    pixels = np.random.default_rng(0).permutation(np.unique(quality_checker._samples.pixel))
    frame.ravel()[pixels[: round(share * pixels.size)]] = 2e4
    assert np.mean(frame.ravel()[quality_checker._samples.pixel] == 2e4) == pytest.approx(share, abs=3e-4)
    assert (Fault.CLIPPED in quality_checker(frame, displacement).faults) == is_found


def test_full_well_below_full_scale_is_found() -> None:
    reconstructor, quality_checker = measured_by("cubic", 1e5)
    frame = exposed(aberrated(1.0), 1e5, 0)
    clipped = np.minimum(frame, 0.8e5) + np.random.default_rng(1).normal(0, READ_NOISE_E, frame.shape)
    clipped = np.asarray(clipped, np.float32)
    found = quality_checker(clipped, reconstructor.register(clipped))
    assert Fault.CLIPPED in found.faults
    assert "shorten the exposure" in found.sentence


@pytest.mark.parametrize(
    ("lenslets", "peak_e"), [((2, 3), 3e3), ((3, 3), 1e4), pytest.param((5, 7), 1e5, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("em_gain", [1.0, 8.0])
def test_200_good_frames_raise_no_alarm(lenslets: tuple[int, int], peak_e: float, em_gain: float) -> None:
    """New exposures of one image, with the noise of a camera with or without a multiplying register."""
    bench, rng = SmallBench(*lenslets), np.random.default_rng(7)
    electrons = bench.reference / bench.reference.max() * peak_e
    noise = CameraNoise(em_gain, READ_NOISE_E, 1.0 if em_gain == 1 else 2.0)
    camera = KnownCamera(np.zeros(electrons.shape, np.uint16), noise=KnownNoise(noise))
    reference = np.asarray(electrons * em_gain, np.float32)
    reconstructor = bench.reconstructor("affine", pupil_modes=None, reference=reference, camera=camera)
    quality_checker = QualityChecker(reconstructor.subimages, reconstructor.registration, camera=camera)
    displacement = reconstructor.register(reference)
    for _ in range(200):
        photons = rng.poisson(electrons)
        counts = photons * em_gain if em_gain == 1 else rng.gamma(np.maximum(photons, 1e-9), em_gain)
        frame = np.rint(np.maximum(counts + rng.normal(0, READ_NOISE_E, counts.shape), 0)).astype(np.uint32)
        assert not quality_checker(frame, displacement).reasons


def test_saturated_lenslets_are_named() -> None:
    reconstructor, quality_checker = measured_by("cubic", 1e4)
    frame = exposed(aberrated(0.5), 1e4, 0)
    found = reconstructor.register(frame)
    outcome = found.outcome.copy()
    outcome[:2] = LensletStatus.SATURATED
    assert not quality_checker(frame, found).faults
    worse = quality_checker(frame, replace(found, outcome=outcome))
    assert worse.faults == Fault.CLIPPED
    count = 2 * outcome.shape[1]
    assert worse.sentence.startswith(f"{count} of {outcome.size} lenslets are saturated: shorten the exposure")


def test_faults_of_the_reference_are_those_of_each_frame() -> None:
    reconstructor, _ = measured_by("cubic", 1e4)
    stale = Quality({Fault.LATTICE: "stale"})
    quality_checker = QualityChecker(reconstructor.subimages, reconstructor.registration, of_reference=stale)
    frame = exposed(aberrated(1.0), 1e4, 0)
    assert quality_checker(frame, reconstructor.register(frame)).reasons == stale.reasons


def test_frame_without_residuals_has_no_misfit() -> None:
    """As a synthetic one; nothing is divided by zero."""
    reconstructor, quality_checker = measured_by("cubic", 1e4)
    frame = exposed(aberrated(1.0), 1e4, 0)
    found = reconstructor.register(frame)
    none = replace(found, chi_square=np.zeros_like(found.chi_square), residual_rms=np.zeros_like(found.residual_rms))
    assert quality_checker(frame, none).faults == Fault(0)


@pytest.mark.slow
def test_large_lattice_is_judged_in_parts() -> None:
    """20 x 24 lenslets: a wavefront passes, a tear does not."""
    bench = SmallBench(20, 24, rotation_rad=0.0)
    quality_checker = QualityChecker(bench.subimages(), bench.reconstructor().registration)
    u, v = bench.pupil_x_m / 5e-3, bench.pupil_y_m / 5e-3
    slopes = np.zeros((20, 24, 3, 2))
    slopes[:, :, 0, 0], slopes[:, :, 0, 1] = 2 * np.cos(2 * u + v), np.cos(2 * u + v)
    modes, variance = LegendreModes(3), np.full(slopes.shape, 1e-6)
    assert quality_checker._slope_misfit_px(converged(modes, slopes, variance), variance[:, :, 0, 0]) < 1e-3
    slopes[5:, :, 0] *= 0.5
    assert quality_checker._slope_misfit_px(converged(modes, slopes, variance), variance[:, :, 0, 0]) > 0.1
