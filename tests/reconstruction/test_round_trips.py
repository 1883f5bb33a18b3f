"""Known phases through the forward model and back: signs, axes, units, and the space-variant terms.

The lattice is 7 x 9, turned and off centre, on a non-square camera, to detect swapped x and y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support.optics import FIELD, SmallBench

from reconstruction.arrays import Floats, Image
from reconstruction.geometry import Field
from reconstruction.settings import RegistrationSettings, Warp
from reconstruction.wavefront import rms

HALF_M = FIELD.half_width_m
Phase = Callable[[Floats, Floats, float, float], Floats]  # of pupil x, y and field x, y, all in m

PHASES: dict[str, Phase] = {
    "tilt along x": lambda u, v, x, y: 3000.0 * u + 0 * v,
    "tilt along y": lambda u, v, x, y: -2000.0 * v + 0 * u,
    "defocus": lambda u, v, x, y: 3e5 * (u**2 + v**2),
    "tilt that grows along the field": lambda u, v, x, y: 2000.0 * u * x / HALF_M + 1500.0 * (v * x + u * y) / HALF_M,
    "astigmatism that turns over the field": lambda u, v, x, y: 3e5 * ((u**2 - v**2) * x - 2 * u * v * y) / HALF_M,
}
ROTATING: dict[str, Phase] = {  # no layers make these
    "tilt that grows along x only": lambda u, v, x, y: 2000.0 * u * x / HALF_M + 1500.0 * v * x / HALF_M,
    "rotation of the field": lambda u, v, x, y: 1500.0 * (v * x - u * y) / HALF_M,
    "turn that grows over the pupil and field": lambda u, v, x, y: 3e5 * (u * v * y + (u**2 - v**2) * x) / HALF_M,
}


def _views(bench: SmallBench, phase: Phase, field: Field = FIELD) -> Floats:
    """The true wavefront of each view at the lenslet centres, without piston."""
    views: Floats = np.array(
        [[phase(bench.pupil_x_m, bench.pupil_y_m, x, y) for x in field.view_x_m] for y in field.view_y_m]
    )
    return np.asarray(views - views.mean(axis=(2, 3), keepdims=True))


def _seen(bench: SmallBench, phase: Phase) -> tuple[Image, Floats]:
    """A frame behind the phase, and its views."""
    u, v = bench.samples()
    return bench.frame(lambda x, y: phase(u, v, x, y).astype(np.float32)), _views(bench, phase)


@pytest.mark.parametrize("name", PHASES)
@pytest.mark.parametrize(("warp", "method"), [("affine", "zonal"), ("affine", "modal"), ("quadratic", "modal")])
def test_closed_form_phase_is_recovered(small_bench: SmallBench, name: str, warp: str, method: str) -> None:
    frame, truth = _seen(small_bench, PHASES[name])
    wavefront = small_bench.reconstructor(warp, method)(frame)
    assert wavefront.displacement.valid.all()
    # Diffraction blurs the displaced image, but the geometric picture displaces the blurred one: a shear over the field
    # is underestimated by 5 %, a stretch by 1 %, a shift not at all.
    figure = 0.06 if "field" in name else 0.005
    assert rms(wavefront.views - truth).max() < figure * rms(truth).max()


def test_columns_of_views_lie_along_x(small_bench: SmallBench) -> None:
    phase = PHASES["tilt that grows along the field"]
    frame, _ = _seen(small_bench, phase)
    field = replace(FIELD, view_rows=2, view_columns=4, view_spacing_m=0.25e-3)
    views = small_bench.reconstructor(field=field)(frame).views
    assert views.shape == (2, 4, 7, 9)
    truth = _views(small_bench, phase, field)
    assert rms(views - truth).max() < 0.06 * rms(truth).max()


@pytest.mark.parametrize("name", ROTATING)
@pytest.mark.parametrize("warp", ["affine", "quadratic"])
def test_rotating_phase_is_recovered_only_with_rotation(small_bench: SmallBench, name: str, warp: Warp) -> None:
    frame, truth = _seen(small_bench, ROTATING[name])
    settings = (RegistrationSettings(warp=warp, rotation=rotation) for rotation in (True, False))
    with_rotation, without = (
        rms(small_bench.reconstructor(registration=each)(frame).views - truth) for each in settings
    )
    assert with_rotation.max() < 0.06 * rms(truth).max()
    assert without.max() > 0.25 * rms(truth).max()


def test_displacement_of_tilt_is_slope_over_slope_per_px(small_bench: SmallBench) -> None:
    u, v = small_bench.samples()
    frame = small_bench.frame(lambda _x, _y: (3000.0 * u + 1000.0 * v).astype(np.float32))
    displacement = small_bench.reconstructor("translation", pupil_modes=3)(frame).displacement
    expected = np.array([3000.0, 1000.0]) / small_bench.sensor.slope_per_px
    np.testing.assert_allclose(displacement.coefficients[:, :, 0], np.broadcast_to(expected, (7, 9, 2)), atol=3e-3)


def test_wavefront_is_recovered_at_any_field_position(small_bench: SmallBench) -> None:
    phase = PHASES["astigmatism that turns over the field"]
    u, v = small_bench.samples()
    wavefront = small_bench.reconstructor()(small_bench.frame(lambda x, y: phase(u, v, x, y).astype(np.float32)))
    truth = phase(small_bench.pupil_x_m, small_bench.pupil_y_m, 0.21e-3, -0.37e-3)
    assert rms(wavefront.at(0.21e-3, -0.37e-3) - truth) < 0.06 * rms(truth)
    with pytest.raises(ValueError, match="outside the field"):
        wavefront.at(0.7e-3, 0.0)


def test_gaussian_bump_is_recovered(checker_bench: SmallBench) -> None:
    """A layer 60 mm before the lenslets; 60 mm over k is what it gathers of light per curvature."""

    def bump(u: Floats, v: Floats, x: float, y: float) -> Floats:
        return 8.0 * np.exp(-(((u - 0.3 * x - 0.4e-3) / 2.0e-3) ** 2 + ((v - 0.3 * y + 0.2e-3) / 1.8e-3) ** 2))

    def amplitude(x: float, y: float) -> Image:
        s, t = (u - 0.3 * x - 0.4e-3) / 2.0e-3, (v - 0.3 * y + 0.2e-3) / 1.8e-3
        share = -60e-3 / checker_bench.sensor.wavenumber_rad_per_m * bump(u, v, x, y)
        along, across = share * (4 * s**2 - 2) / 2.0e-3**2, share * (4 * t**2 - 2) / 1.8e-3**2
        mixed = share * 4 * s * t / 2.0e-3 / 1.8e-3
        return np.sqrt((1 + along) * (1 + across) - mixed**2).astype(np.float32)

    u, v = checker_bench.samples()
    frame = checker_bench.frame(lambda x, y: bump(u, v, x, y).astype(np.float32), amplitude)
    truth = _views(checker_bench, bump)
    residual = {
        warp: rms(checker_bench.reconstructor(warp, pupil_modes=36)(frame).views - truth).mean()
        for warp in ("translation", "affine", "quadratic")
    }
    assert residual["affine"] < 0.1 * residual["translation"]
    assert residual["quadratic"] < 0.75 * residual["affine"]
    assert residual["quadratic"] < 0.01 * rms(truth).mean()


def test_inputs_are_untouched_and_results_repeat(small_bench: SmallBench) -> None:
    u, v = small_bench.samples()
    frame = small_bench.frame(lambda _x, _y: (1000.0 * u + 0 * v).astype(np.float32))
    copy, reference = frame.copy(), small_bench.reference.copy()
    reconstructor = small_bench.reconstructor()
    first, second = reconstructor(frame), reconstructor(frame)
    np.testing.assert_array_equal(first.views, second.views)
    np.testing.assert_array_equal(frame, copy)
    np.testing.assert_array_equal(small_bench.reference, reference)
