"""Error bars against the scatter of many noisy frames."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from support.optics import SmallBench

from reconstruction.arrays import Floats, Image
from reconstruction.displacement import RegistrationMethod
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.frame.pixels import KnownCamera
from reconstruction.frame.spline import noise_power
from reconstruction.modes.polynomials import legendre, legendre_gradients
from reconstruction.registration import prepare_registration
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings

DRAWS = 60
NOISY_FRAMES = {  # electrons of the brightest pixel, read noise in electrons, excess noise, brightness over reference
    "bright": (10000.0, 8.0, 1.0, 1.0),
    "dim": (300.0, 8.0, 1.0, 1.0),
    "dimmer than the reference": (600.0, 8.0, 1.0, 0.4),
    "multiplied": (100.0, 0.5, 2.0, 1.3),
}


@pytest.fixture(scope="module")
def deformed(checker_bench: SmallBench) -> Image:
    """A frame whose subimages lie at all fractions of a pixel, sheared and stretched."""
    u, v = checker_bench.samples()

    def phase(x: float, y: float) -> Image:
        return (1500.0 * u + 500.0 * v + 4e5 * u * x + 3e5 * (u**2 + v**2) + 2e8 * v * (u * y + v * x / 2)).astype(
            np.float32
        )

    return checker_bench.frame(phase)


def _estimator(
    bench: SmallBench, electrons: float, noise: CameraNoise | None, *, rotation: bool = False
) -> RegistrationMethod:
    """Quadratic registration against a reference with that many electrons in its brightest pixel."""
    reference = bench.reference * np.float32(electrons / bench.reference.max())
    subimages = ReferenceSubimages(
        reference, sensor=bench.sensor, lattice=bench.lattice, field=bench.field, noise=KnownNoise(noise)
    )
    return prepare_registration(subimages, RegistrationSettings(rotation=rotation), bench.field)


def _exposed(light: Image, read_noise: float, excess_noise: float, rng: np.random.Generator) -> Image:
    """A frame of `light` electrons with Poisson noise, and Gaussian excess and read noise."""
    shot = rng.poisson(light) + np.sqrt((excess_noise - 1) * light) * rng.normal(size=light.shape)
    return np.asarray(shot + rng.normal(0, read_noise, light.shape), np.float32)


def _free_directions(*, rotation: bool) -> Floats:
    """Orthonormal coefficients (field_mode, xy), flattened, that a quadratic warp can find: 12, or 9 gradients."""
    if rotation:
        return np.eye(12)
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 50))
    slopes = np.moveaxis(legendre_gradients(10, x, y)[1:], -1, 1)  # of potentials: (potential, xy, point)
    coefficients = slopes @ np.linalg.pinv(legendre(6, x, y))
    return np.asarray(np.linalg.qr(np.swapaxes(coefficients, 1, 2).reshape(-1, 12).T)[0].T)


@pytest.mark.parametrize(("name", "rotation"), [*((name, False) for name in NOISY_FRAMES), ("dim", True)])
def test_errors_match_sigma_and_chi_square_is_one(
    checker_bench: SmallBench, deformed: Image, name: str, *, rotation: bool
) -> None:
    electrons, read_noise, excess_noise, brightness = NOISY_FRAMES[name]
    estimate = _estimator(checker_bench, electrons, CameraNoise(1.0, read_noise, excess_noise), rotation=rotation)
    light = np.maximum(deformed * np.float32(brightness * electrons / checker_bench.reference.max()), 0)
    nowhere: NDArray[np.bool_] = np.zeros(light.shape, np.bool_)
    still = estimate(light, saturated=nowhere)
    rng = np.random.default_rng(3)
    noisy = [estimate(_exposed(light, read_noise, excess_noise, rng), saturated=nowhere) for _ in range(30)]
    error = np.array([frame.coefficients - still.coefficients for frame in noisy])
    sigma = np.sqrt(np.array([frame.variance for frame in noisy]))
    inside = np.mean(np.abs(error) < sigma, axis=(0, 1, 2))  # (field_mode, xy)
    np.testing.assert_allclose(inside, 0.683, atol=0.05)
    assert np.mean(np.abs(error) < sigma) == pytest.approx(0.683, abs=0.015)
    chi_square = np.array([frame.chi_square for frame in noisy]).mean(axis=0) - still.chi_square
    np.testing.assert_allclose(chi_square, 1.0, atol=0.08)
    # Errors of a lenslet's coefficients are correlated as in the covariance.
    basis = _free_directions(rotation=rotation)
    covariance = basis @ noisy[0].covariance.reshape(-1, 12, 12) @ basis.T
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), (error.reshape(30, -1, 12) @ basis.T)[..., None])[..., 0]
    together = np.einsum("dli,dlj->ij", whitened, whitened) / whitened[..., 0].size
    np.testing.assert_allclose(together, np.eye(len(basis)), atol=0.12)


def test_residual_replaces_unknown_noise(checker_bench: SmallBench, deformed: Image) -> None:
    displacement = _estimator(checker_bench, 300.0, None)(deformed, saturated=np.zeros(deformed.shape, np.bool_))
    assert np.isnan(displacement.chi_square).all()
    basis = _free_directions(rotation=False)
    assert np.all(np.linalg.eigvalsh(basis @ displacement.covariance.reshape(-1, 12, 12) @ basis.T) > 0)


@pytest.mark.parametrize(("is_known", "tolerance"), [(True, 0.1), (False, 0.15)])
def test_scatter_of_coefficients_matches_sigma(checker_bench: SmallBench, is_known: bool, tolerance: float) -> None:
    u, v = checker_bench.samples()
    frame = checker_bench.frame(lambda x, _y: (1500.0 * u + 500.0 * v + 4e5 * u * x).astype(np.float32))
    noise = 0.03 * float(frame.max())  # well above the systematic error
    # If it is unknown, its share in each field mode is unknown, too, but not its mean.
    reconstructor = checker_bench.reconstructor(
        "quadratic", pupil_modes=15, noise=CameraNoise(1e-9 * noise, noise) if is_known else None
    )
    generator = np.random.default_rng(0)
    solutions = [
        reconstructor(frame + generator.normal(0, noise, frame.shape).astype(np.float32)).solution for _ in range(DRAWS)
    ]
    coefficients = np.array([solution.coefficients for solution in solutions])  # type: ignore[union-attr] # modal
    sigma = np.array([solution.coefficients_sigma for solution in solutions]).mean(axis=0)  # type: ignore[union-attr] # the same
    ratio = coefficients.std(axis=0, ddof=1)[1:] / sigma[1:]  # without the piston
    # If it is unknown, all errors count as systematic, alike in four lenslets.
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1 if is_known else 0.5, abs=tolerance)


def test_scatter_of_zonal_phase_matches_sigma(checker_bench: SmallBench) -> None:
    u, v = checker_bench.samples()
    frame = checker_bench.frame(lambda x, _y: (1500.0 * u + 4e5 * v * x).astype(np.float32))
    noise = 0.03 * float(frame.max())
    reconstructor = checker_bench.reconstructor("quadratic", method="zonal", noise=CameraNoise(1e-9 * noise, noise))
    generator = np.random.default_rng(1)
    wavefronts = [
        reconstructor(frame + generator.normal(0, noise, frame.shape).astype(np.float32)) for _ in range(DRAWS // 2)
    ]
    scatter = np.array([wavefront.views for wavefront in wavefronts]).std(axis=0, ddof=1)
    sigma = np.array([wavefront.sigma() for wavefront in wavefronts]).mean(axis=0)
    known = np.isfinite(sigma) & (sigma > 0)
    assert known.sum() > 9 * 55
    assert np.sqrt(np.mean((scatter[known] / sigma[known]) ** 2)) == pytest.approx(1, abs=0.1)


def test_unknown_noise_counts_the_parameters_that_fit_it(checker_bench: SmallBench) -> None:
    """27 of 126 slopes go into the modes: the others show the noise, which the estimate must not divide by 126."""
    u, v = checker_bench.samples()
    frame = checker_bench.frame(lambda x, _y: (1500.0 * u + 4e5 * v * x).astype(np.float32))
    noise, generator = 0.03 * float(frame.max()), np.random.default_rng(2)
    noisy = [frame + generator.normal(0, noise, frame.shape).astype(np.float32) for _ in range(10)]
    shares = []  # of the variance, over that of known noise
    for modes in (10, 28):
        variance = []
        for known in (None, CameraNoise(1e-9 * noise, noise)):
            reconstructor = checker_bench.reconstructor("quadratic", pupil_modes=modes, noise=known)
            solutions = [reconstructor(each).solution for each in noisy]
            variance.append(np.mean([solution.coefficients_sigma[1:9] ** 2 for solution in solutions], axis=0))  # type: ignore[union-attr] # modal
        shares.append(variance[0] / variance[1])
    assert float(np.median(shares[1] / shares[0])) == pytest.approx(1, abs=0.08)


def test_noise_of_the_reference_falls_with_its_frames(checker_bench: SmallBench) -> None:
    noise = CameraNoise(1e-9, 0.03 * float(checker_bench.reference.max()))
    variance = {
        frames: checker_bench.reconstructor("quadratic", camera=KnownCamera(noise=KnownNoise(noise, frames)))
        .register(checker_bench.reference)
        .variance.mean()
        for frames in (1, 4, 10**6)
    }
    of_reference = {frames: variance[frames] - variance[10**6] for frames in (1, 4)}
    assert of_reference[1] / of_reference[4] == pytest.approx(4, rel=1e-3)
    assert of_reference[1] / variance[10**6] == pytest.approx(1, abs=0.35)  # interpolation smooths that of the frame


def test_interpolated_noise_matches_scipy() -> None:
    noise = np.random.default_rng(0).normal(size=(400, 400))
    y, x = np.meshgrid(np.arange(20, 380), np.arange(20, 380), indexing="ij")
    for fraction_x, fraction_y in ((0.0, 0.0), (0.5, 0.0), (0.25, 0.5), (0.5, 0.5)):
        values = ndimage.map_coordinates(noise, [y + fraction_y, x + fraction_x], order=3, mode="mirror")
        expected = values.var() / noise.var()
        np.testing.assert_allclose(noise_power(np.array([7 + fraction_x, 3 + fraction_y])), expected, rtol=0.02)
