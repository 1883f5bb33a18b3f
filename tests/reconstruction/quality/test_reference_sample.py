"""A reference with a sample in the beam is told from one without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.estimators import estimator_with
from support.optics import FIELD, SmallBench
from support.polynomial_layers import PHASE, light

from app.bench.config import Bench
from reconstruction.arrays import Floats, Image
from reconstruction.quality.reference_quality import sample_quality, shared_deformation_px
from reconstruction.quality.verdict import Fault
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings

BENCHES = pytest.mark.parametrize("name", ["small_bench", "checker_bench"])


def behind(bench: SmallBench, strength: float, *, half: bool = False) -> Image:
    """A frame behind a layer, or with a layer before half of the lenslets."""
    u, v = bench.samples()

    def part(k: int) -> object:
        def field(x: float, y: float) -> Image:
            values = light(strength * PHASE, -0.3, u, v, x, y)[k]
            return np.where(u < 0, values, k).astype(np.float32) if half else values.astype(np.float32)

        return field

    return bench.frame(part(0), part(1))  # type: ignore[arg-type] # fields at a point


def cut(bench: SmallBench, image: Image) -> ReferenceSubimages:
    return ReferenceSubimages(image, sensor=bench.sensor, lattice=bench.lattice, field=bench.field)


def noisy(image: Image, peak_e: float, seed: int) -> Image:
    generator = np.random.default_rng(seed)
    scale = peak_e / image.max()
    counts = generator.poisson(np.maximum(image, 0) * scale) + generator.normal(0, 8, image.shape)
    return np.asarray(counts / scale, np.float32)


def within_lenslets(bench: SmallBench) -> tuple[Floats, Floats, np.ndarray]:
    """Positions within lenslets, half a pitch, and the (row, column) of the lenslet, of each sample of the pupil."""
    u, v = bench.samples()
    pitch_m, (rows, columns) = bench.sensor.lenslet_pitch_m, bench.sensor.lenslets
    column, row = u / pitch_m + (columns - 1) / 2, v / pitch_m + (rows - 1) / 2
    of_lenslet = np.stack(np.broadcast_arrays(np.rint(row), np.rint(column))).astype(int)
    s, t = 2 * (column - of_lenslet[1]), 2 * (row - of_lenslet[0])
    assert max(np.abs(s).max(), np.abs(t).max()) < 1
    return s, t, of_lenslet


@BENCHES
def test_reference_without_a_sample_passes_in_noise(request: pytest.FixtureRequest, name: str) -> None:
    bench: SmallBench = request.getfixturevalue(name)
    assert shared_deformation_px(bench.subimages()) < 1e-3
    for seed in range(20):
        assert not sample_quality(cut(bench, noisy(bench.reference, 200, seed))).faults


@BENCHES
def test_imperfect_lenslets_are_no_sample(request: pytest.FixtureRequest, name: str) -> None:
    """Lenslets that shift, magnify or blur their own images by chance, or all of them alike."""
    bench: SmallBench = request.getfixturevalue(name)
    s, t, of_lenslet = within_lenslets(bench)
    generator = np.random.default_rng(0)
    lenslets = bench.sensor.lenslets
    tilt_u, tilt_v, defocus, coma = generator.normal(0, 0.4, (4, *lenslets))[:, *of_lenslet]  # rad at the border
    focal = generator.normal(0, 0.01, lenslets)[*of_lenslet]
    per_m = bench.sensor.wavenumber_rad_per_m / FIELD.collimator_focal_length_m * bench.sensor.lenslet_pitch_m / 2
    square = s**2 + t**2

    def by_chance(x: float, y: float) -> Image:
        aberration = tilt_u * s + tilt_v * t + defocus * square + coma * s * square
        return np.asarray(aberration + focal * per_m * (x * s + y * t), np.float32)

    assert not sample_quality(cut(bench, bench.frame(by_chance))).faults
    alike = bench.frame(lambda _x, _y: (0.8 * s * square + 0.5 * square).astype(np.float32))
    assert shared_deformation_px(cut(bench, alike)) < 1e-3


@BENCHES
def test_light_and_lattice_are_no_sample(request: pytest.FixtureRequest, name: str) -> None:
    """An uneven source, a gradient, defocus, a round pupil, and a lattice that is not quite where it is said."""
    bench: SmallBench = request.getfixturevalue(name)
    u, v = (axis / bench.sensor.pupil_half_width_m[0] for axis in bench.samples())
    flat = np.zeros((v.shape[0], u.shape[1]), np.float32)
    x, y = bench.source.position_m.T / FIELD.half_width_m
    uneven = replace(bench.source, area_m2=bench.source.area_m2 * (1 + 0.6 * x + 0.3 * y))
    bright = np.linspace(1, 0.4, bench.reference.shape[1], dtype=np.float32)
    images = {
        "uneven source": bench.model.irradiance(uneven) * np.float32(1e14),
        "gradient": bench.reference * bright,
        "defocus": bench.frame(lambda _x, _y: (6 * (u**2 + v**2)).astype(np.float32)),
        "round pupil": bench.frame(lambda _x, _y: flat, lambda _x, _y: (u**2 + v**2 < 1).astype(np.float32)),
    }
    for what, image in images.items():
        assert not sample_quality(cut(bench, image)).faults, what
    assert shared_deformation_px(cut(bench, images["defocus"])) < 5e-3  # although subimages move by pixels
    for lattice in (
        replace(bench.lattice, pitch_px=31.4),
        replace(bench.lattice, center_x_px=bench.lattice.center_x_px + 2),
    ):
        shifted = ReferenceSubimages(bench.reference, sensor=bench.sensor, lattice=lattice, field=bench.field)
        assert shared_deformation_px(shifted) < 5e-3


@BENCHES
@pytest.mark.parametrize(("strength", "half"), [(1.0, False), (0.7, False), (1.0, True)])
def test_reference_with_a_sample_is_found(
    request: pytest.FixtureRequest, name: str, strength: float, *, half: bool
) -> None:
    """As when frame and reference are exchanged, or the sample is half in."""
    bench: SmallBench = request.getfixturevalue(name)
    frame = behind(bench, strength, half=half)
    for image in (frame, noisy(frame, 300, 0)):
        assert sample_quality(cut(bench, image)).faults == Fault.SAMPLE
    reconstructor = bench.reconstructor(reference=frame, registration=RegistrationSettings(warp="affine"))
    quality_checker = estimator_with(
        reconstructor, Bench(sensor=bench.sensor, field=bench.field), frame
    ).quality_checker
    assert Fault.SAMPLE in quality_checker.of_reference.faults
    assert "was the sample in" in quality_checker.of_reference.sentence
