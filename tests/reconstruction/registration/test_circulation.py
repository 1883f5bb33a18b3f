"""Rotation of subimages: measured where a sample makes it, not claimed where layers or the source do not show it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support.optics import FIELD, PAPER, SmallBench, checkerboard, converged

from reconstruction.arrays import Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.frame.noise import CameraNoise
from reconstruction.geometry import Field
from reconstruction.modes.field_modes import LegendreModes, PolynomialModes, ZernikeModes
from reconstruction.registration.circulation import Circulation, measure_circulation
from reconstruction.settings import RegistrationSettings, Warp
from simulated_devices.optics.source import SourcePoints, source_points
from simulated_devices.settings import Source

HALF_M = FIELD.half_width_m
TWIST = 400.0  # rad/m at the field's edge
Phase = Callable[[Floats, Floats, float, float], Floats]  # of pupil x, y and field x, y, all in m


def layer(s: Floats, t: Floats) -> Floats:
    """Phase of a layer, rad; s and t in m."""
    s, t = s / 2.4e-3, t / 2.4e-3
    return np.asarray(2.5 * np.sin(1.7 * s + 0.4) * np.cos(1.3 * t) + 1.5 * s * t - 1.2 * t**3 + 0.8 * s**2)


LAYERS: dict[str, Phase] = {
    "nothing": lambda u, v, _x, _y: 0 * u + 0 * v,
    "one layer": lambda u, v, x, y: layer(u + 0.97 * x, v + 0.97 * y),
    "two strong layers": lambda u, v, x, y: 2 * layer(u + 0.97 * x, v + 0.97 * y) + 2 * layer(v + 0.3 * y, u + 0.3 * x),
    "near the source": lambda u, v, x, y: 3 * layer(0.1 * u + 4 * x, 0.1 * v + 4 * y),
}


class CirculationBench(SmallBench):
    """A small bench whose warps may rotate."""

    def __init__(self, field: Field = PAPER, source: SourcePoints | None = None) -> None:
        super().__init__(5, 7, field=field, source=source)
        self.half_width_px = FIELD.half_width_px(self.sensor)

    def seen(self, phase: Phase) -> Image:
        """The frame behind a phase."""
        u, v = self.samples()
        return self.frame(lambda x, y: phase(u, v, x, y).astype(np.float32))

    def registered(self, frame: Image, warp: Warp = "quadratic", noise: CameraNoise | None = None) -> Displacement:
        """Displacements by a warp that may rotate."""
        registration = RegistrationSettings(warp=warp, rotation=True)
        return self.reconstructor(registration=registration, pupil_modes=None, noise=noise).register(frame)

    def measured(self, frame: Image, warp: Warp = "quadratic", noise: CameraNoise | None = None) -> Circulation:
        """Circulation of the subimages."""
        circulation = measure_circulation(self.registered(frame, warp, noise), self.half_width_px)
        assert circulation is not None
        return circulation

    @property
    def twist_rad(self) -> float:
        """Rotation of every subimage behind `twist`."""
        return TWIST / self.sensor.slope_per_px / self.half_width_px


def twist(u: Floats, v: Floats, x: float, y: float) -> Floats:
    """A phase that turns every subimage from +x to +y: d = (-y, x)."""
    return np.asarray(TWIST / HALF_M * (v * x - u * y))


@pytest.fixture(scope="module")
def bench() -> CirculationBench:
    return CirculationBench()


@pytest.fixture(scope="module")
def round_bench() -> CirculationBench:
    return CirculationBench(source=source_points("circle", Source(), object_samples=19))


@pytest.fixture(scope="module", params=["square", "checkerboard"])
def real_bench(request: pytest.FixtureRequest) -> CirculationBench:
    """In real light a square hides some displacements of a quadratic warp, a checkerboard none."""
    return CirculationBench(FIELD, checkerboard() if request.param == "checkerboard" else None)


@pytest.mark.parametrize("name", LAYERS)
@pytest.mark.parametrize("warp", ["affine", "quadratic", "cubic"])
def test_layers_raise_no_warning(bench: CirculationBench, name: str, warp: Warp) -> None:
    circulation = bench.measured(bench.seen(LAYERS[name]), warp)
    assert not circulation.contradicts_layers
    assert abs(circulation.significance) < 2


@pytest.mark.parametrize("warp", ["affine", "quadratic"])
def test_rotating_sample_contradicts_layers(bench: CirculationBench, warp: Warp) -> None:
    frame = bench.seen(lambda u, v, x, y: twist(u, v, x, y) + LAYERS["one layer"](u, v, x, y))
    circulation = bench.measured(frame, warp)
    assert circulation.contradicts_layers
    assert circulation.significance > 5
    # Diffraction blurs the moved image: a shear is underestimated by 5 %.
    assert circulation.mean_rad == pytest.approx(bench.twist_rad, rel=0.07)
    np.testing.assert_allclose(circulation.rotation_rad, bench.twist_rad, rtol=0.15)
    other_way = bench.measured(bench.seen(lambda u, v, x, y: -twist(u, v, x, y)), warp)
    assert other_way.mean_rad == pytest.approx(-bench.twist_rad, rel=0.07)
    assert other_way.contradicts_layers


def test_rotation_is_found_in_real_light(real_bench: CirculationBench) -> None:
    """The determinant of a rotation is 1 + rotation^2, the same all over the pupil: uniform light."""
    turned = real_bench.measured(real_bench.seen(twist))
    assert turned.contradicts_layers
    assert turned.mean_rad == pytest.approx(real_bench.twist_rad, rel=0.07)
    still = real_bench.measured(real_bench.seen(LAYERS["nothing"]))
    assert not still.contradicts_layers
    assert still.is_shown


@pytest.mark.parametrize("field", [FIELD, PAPER], ids=["real light", "paper"])
def test_rotation_that_a_disc_hides_is_not_measured(field: Field) -> None:
    """What the source hardly shows is left out of the warp, as if the registration excluded it."""
    round_bench = CirculationBench(field, source_points("circle", Source(), object_samples=19))
    displacement = round_bench.registered(round_bench.seen(twist), "affine")
    assert measure_circulation(displacement, round_bench.half_width_px) is None
    circulation = round_bench.measured(round_bench.seen(twist), "quadratic")
    assert not circulation.is_shown
    assert not circulation.contradicts_layers


def test_cylinder_lens_contradicts_layers_without_a_mean_rotation(bench: CirculationBench) -> None:
    """Different magnifications turn subimages by amounts whose sign varies over the pupil."""
    circulation = bench.measured(bench.seen(lambda u, v, x, y: 2 * layer(u + 0.97 * x, v + 0 * y)), "affine")
    assert circulation.contradicts_layers
    assert circulation.chi_square > 4
    assert abs(circulation.significance) < 5


@pytest.mark.slow
def test_rotation_is_that_of_closed_form_with_its_scatter(bench: CirculationBench) -> None:
    per_electron = float(bench.reference.max()) / 1000
    noise = CameraNoise(per_electron, 8 * per_electron)
    frame, rng = bench.seen(twist), np.random.default_rng(2)
    draws = [
        bench.measured(
            (frame + np.sqrt(noise.variance(frame)) * rng.normal(size=frame.shape)).astype(np.float32), noise=noise
        )
        for _ in range(12)
    ]
    scatter = np.std([draw.rotation_rad for draw in draws], axis=0, ddof=1)
    sigma = np.mean([draw.rotation_sigma_rad for draw in draws])
    assert np.sqrt(np.mean(scatter**2)) == pytest.approx(sigma, rel=0.1)


@pytest.mark.parametrize("warp", ["quadratic", "cubic"])
@pytest.mark.parametrize("electrons", [None, 1000])
def test_disc_shows_no_rotation_and_raises_no_warning(
    round_bench: CirculationBench, warp: Warp, electrons: int | None
) -> None:
    frame = round_bench.seen(lambda u, v, x, y: twist(u, v, x, y) + LAYERS["one layer"](u, v, x, y))
    noise = None
    if electrons is not None:
        per_electron = float(round_bench.reference.max()) / electrons
        noise = CameraNoise(per_electron, 8 * per_electron)
        frame += (np.sqrt(noise.variance(frame)) * np.random.default_rng(1).normal(size=frame.shape)).astype(np.float32)
    circulation = round_bench.measured(frame, warp, noise=noise)
    assert not circulation.is_shown
    assert not circulation.contradicts_layers
    assert (circulation.mean_rad, circulation.significance) == (0.0, 0.0)
    assert np.isnan(circulation.rotation_rad).all()
    assert np.isfinite(circulation.chi_square)


def test_few_bad_lenslets_do_not_raise_a_warning(bench: CirculationBench) -> None:
    displacement = bench.registered(bench.seen(LAYERS["one layer"]))
    coefficients = displacement.coefficients.copy()
    for row, column, error_px in ((0, 0, 2.0), (2, 3, -2.0), (3, 1, 2.0), (4, 6, -2.0), (1, 5, 2.0), (0, 4, -2.0)):
        coefficients[row, column, 1, 1] += error_px
        coefficients[row, column, 2, 0] -= error_px
    circulation = measure_circulation(replace(displacement, coefficients=coefficients), bench.half_width_px)
    assert circulation is not None
    assert not circulation.contradicts_layers


def test_lost_lenslets_are_left_out(bench: CirculationBench) -> None:
    frame = bench.seen(twist)
    x, y = bench.lattice.lenslet_centers_px(5, 7)[1, 4]
    frame[int(y) - 15 : int(y) + 16, int(x) - 15 : int(x) + 16] = 0
    circulation = bench.measured(frame)
    assert np.argwhere(np.isnan(circulation.rotation_rad)).tolist() == [[1, 4]]
    assert circulation.mean_rad == pytest.approx(bench.twist_rad, rel=0.07)


@pytest.mark.parametrize(
    "modes", [LegendreModes(3), LegendreModes(6), LegendreModes(10), ZernikeModes(3), ZernikeModes(6)]
)
def test_rigid_rotation_is_exact_and_gradients_have_none(modes: PolynomialModes) -> None:
    """By coefficients of closed-form displacements: the rotation (-y, x), and the gradient of x^2 y / 2 + 3 x y."""
    x, y = np.random.default_rng(1).uniform(-1, 1, (2, 200))
    to_modes = np.linalg.pinv(modes.values(x, y))
    turned = np.stack([-y, x], axis=-1)
    graded = np.stack([3 * y + x * y * (modes.count > 3), 3 * x + x**2 / 2 * (modes.count > 3)], axis=-1)
    sensitivity = np.random.default_rng(2).normal(size=(2 * modes.count, 40))  # any, with correlations
    covariance = (1e-4 * sensitivity @ sensitivity.T).reshape(modes.count, 2, modes.count, 2)

    def measured(displacement: Floats) -> Circulation:
        coefficients = np.broadcast_to((displacement.T @ to_modes).T, (4, 5, modes.count, 2))
        known = converged(modes, coefficients, np.ones_like(coefficients))
        both = replace(known, covariance_source=np.broadcast_to(covariance, (4, 5, *covariance.shape)))
        circulation = measure_circulation(both, 8.0)
        assert circulation is not None
        return circulation

    np.testing.assert_allclose(measured(0.8 * turned).rotation_rad, 0.1, rtol=1e-9)
    assert measured(0.8 * turned).mean_rad == pytest.approx(0.1)
    np.testing.assert_allclose(measured(graded).rotation_rad, 0, atol=1e-12)
    assert measured(graded).chi_square < 1e-12
    np.testing.assert_allclose(measured(graded + 0.8 * turned).rotation_rad, 0.1, rtol=1e-9)


def test_nothing_is_measured_where_rotation_is_excluded_or_errors_are_uncorrelated(bench: CirculationBench) -> None:
    frame = bench.seen(twist)
    for warp in ("affine", "quadratic", "cubic"):
        gradients = bench.reconstructor(warp, pupil_modes=None).register(frame)
        assert measure_circulation(gradients, bench.half_width_px) is None
    assert measure_circulation(bench.registered(frame, "translation"), bench.half_width_px) is None
    uncorrelated = converged(LegendreModes(3), np.ones((2, 3, 3, 2)), np.ones((2, 3, 3, 2)))
    assert measure_circulation(uncorrelated, bench.half_width_px) is None
    lost = replace(bench.registered(frame), outcome=np.ones((5, 7), np.int8))
    assert measure_circulation(lost, bench.half_width_px) is None
