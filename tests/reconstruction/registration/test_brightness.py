"""A brightness that varies over the field, as behind a sample that absorbs, is no displacement."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import SmallBench

from reconstruction.arrays import Floats
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.registration.gauss_newton import GaussNewton
from reconstruction.registration.subimages import ReferenceSubimages
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import SourcePoints

POLYNOMIALS = LegendreModes(10)


def prepared(
    bench: SmallBench, peak_e: float, *, is_modelled: bool = True, absorbs: bool = True
) -> tuple[GaussNewton, LensletImage]:
    """A quartic registration for so many electrons in the reference's brightest pixel, and the model of a lenslet."""
    noise = CameraNoise(counts_per_electron=float(bench.reference.max()) / peak_e, read_noise_counts=0.0)
    reference = ReferenceSubimages(
        bench.reference, sensor=bench.sensor, lattice=bench.lattice, field=bench.field, noise=KnownNoise(noise)
    )
    model = LensletImage(
        bench.sensor, bench.field, bench.source, width=reference.width, pupil_samples=12, pixel_fill_factor=1.0
    )
    given = model if is_modelled else None
    modes = LegendreModes(15)
    method = GaussNewton(reference, modes, conserve_flux=False, may_rotate=False, model=given, absorbs=absorbs)
    return method, model


@pytest.mark.parametrize("highest", [1, 2, 3])
def test_rendered_brightness_is_no_displacement(checker_bench: SmallBench, highest: int) -> None:
    """The light of the object points changes by some percent, in a polynomial of x and y; nothing moves."""
    bench = checker_bench
    x, y = bench.source.position_m.T / bench.field.half_width_m
    sizes = {1: 0.06 * x - 0.03 * y, 2: 0.04 * x * y - 0.03 * x**2, 3: 0.02 * x**3 - 0.02 * x * y**2}
    brightness = 1 + np.sum([size for degree, size in sizes.items() if degree <= highest], axis=0)
    source = SourcePoints(position_m=bench.source.position_m, area_m2=bench.source.area_m2 * brightness)
    frame = bench.model.irradiance(source) * np.float32(1e14)

    def moved_px(*, is_modelled: bool = True, absorbs: bool = True) -> float:
        method, _ = prepared(bench, 1e6, is_modelled=is_modelled, absorbs=absorbs)
        found = method(frame, saturated=np.zeros(frame.shape, np.bool_))
        assert found.valid.all()
        assert found.absorbs == (absorbs and is_modelled)
        return float(np.sqrt(np.mean(found.coefficients**2)))

    assert moved_px() < 2e-4
    assert moved_px(is_modelled=False) > 1e-3
    assert (moved_px(absorbs=False) < 2e-4) == (highest == 1)  # of other samples, only what is linear


def found_px(bench: SmallBench, peak_e: float) -> Floats:
    """Displacement found for a brightness in each polynomial, px, RMS over lenslets and parameters, (polynomial,)."""
    method, model = prepared(bench, peak_e)
    changes = np.stack([model.image(values) for values in POLYNOMIALS.values(*model.position.T)])
    return np.asarray(np.sqrt(np.mean(method.response(model.image(), changes) ** 2, axis=(0, 2))))


def test_cubic_brightness_is_taken_out_where_noise_allows(checker_bench: SmallBench) -> None:
    """In noise, more unknowns would cost more than a cubic brightness does."""
    much_light, little_light = (found_px(checker_bench, peak_e) for peak_e in (1e5, 100))
    np.testing.assert_allclose(much_light, 0, atol=0.002)
    np.testing.assert_allclose(little_light[:6], 0, atol=0.002)
    assert little_light[6:].min() > 0.08
