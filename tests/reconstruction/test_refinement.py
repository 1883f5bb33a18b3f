"""Refinement on a small bench, against wavefronts in closed form."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from support.optics import FIELD, SmallBench, checkerboard
from support.own_wavefronts import Lenslets

from app.bench.config import Bench
from app.bench.imaging_model import BenchModel, measured_source
from reconstruction.arrays import Floats, PointField
from reconstruction.errors import ReconstructionError
from reconstruction.reconstructor import Reconstructor
from reconstruction.refinement import Refinement, Round
from reconstruction.wavefront import rms, without_piston
from simulated_devices.optics.source import SourcePoints

HALF_M = FIELD.half_width_m


class Bowl:
    """A cubic wavefront that grows over the field, strong enough to bias a single pass, and its light."""

    def __init__(self, bench: SmallBench) -> None:
        self._half_m, self._field = bench.sensor.pupil_half_width_m[0], bench.field
        self._gathered = 0.2 / bench.sensor.wavenumber_rad_per_m / self._half_m / HALF_M
        self.samples = bench.samples()
        views = FIELD.view_x_m
        self.views = without_piston(
            np.array([[self.phase(x, y, bench.pupil_x_m, bench.pupil_y_m) for x in views] for y in views])
        )

    def phase(self, x_m: float, y_m: float, u_m: Floats, v_m: Floats) -> Floats:
        u, v, x, y = u_m / self._half_m, v_m / self._half_m, x_m / HALF_M, y_m / HALF_M
        at_rest = 5 * (u**2 + v**2) + 4 * u**3 - 3 * u * v**2
        return np.asarray(at_rest + 4 * x * u * v + 2 * y * u**2 + 1.5 * x * x * v + 3 * x * y * u)

    def at_samples(self, x_m: float, y_m: float) -> NDArray[np.float32]:
        return self.phase(x_m, y_m, *self.samples).astype(np.float32)

    def amplitude(self, x_m: float, y_m: float) -> NDArray[np.float32]:
        """In real light sqrt(det(1 + f1/k d2phi/dx du)); 1 in the paper's world."""
        (u, v), x, y = (samples / self._half_m for samples in self.samples), x_m / HALF_M, y_m / HALF_M
        g = 0.0 if self._field.neglect_propagation else self._gathered
        return np.sqrt(1 + g * (4 * v + 3 * y) - g**2 * (4 * u + 3 * x) ** 2).astype(np.float32)

    def field(self, x_m: float, y_m: float) -> NDArray[np.complex64]:
        return np.asarray(self.amplitude(x_m, y_m) * np.exp(1j * self.at_samples(x_m, y_m)), np.complex64)

    def frame(self, bench: SmallBench) -> NDArray[np.float32]:
        return bench.frame(self.at_samples, self.amplitude)


@pytest.fixture(scope="module")
def bowl(checker_bench: SmallBench) -> Bowl:
    return Bowl(checker_bench)


def settings_of(bench: SmallBench) -> Bench:
    return Bench(sensor=bench.sensor, field=bench.field, lattice=bench.lattice)


def refined(bench: SmallBench, reconstructor: Reconstructor, frame: NDArray[Any], rounds: int = 3) -> Iterator[Round]:
    model = BenchModel(settings_of(bench), reconstructor)
    return Refinement(reconstructor, model).rounds(reconstructor.register(frame), rounds)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["modal", "zonal"])
@pytest.mark.parametrize("world", ["checker_bench", "paper_bench"])
def test_refinement_removes_bias(request: pytest.FixtureRequest, world: str, method: str) -> None:
    bench: SmallBench = request.getfixturevalue(world)
    bowl = Bowl(bench)
    frame = bowl.frame(bench)
    reconstructor = bench.reconstructor("cubic", method, None)
    once = rms(reconstructor(frame).views - bowl.views).mean()
    residuals = [rms(each.wavefront.views - bowl.views).mean() for each in refined(bench, reconstructor, frame)]
    assert once > 0.015
    assert residuals[-1] < (0.2 if method == "modal" else 0.9) * once  # zonal: Southwell's error remains
    assert len(residuals) <= 3


@pytest.mark.slow
@pytest.mark.long
def test_model_without_gathered_light_is_worse(checker_bench: SmallBench, bowl: Bowl) -> None:
    reconstructor = checker_bench.reconstructor("cubic", pupil_modes=None)
    frame = bowl.frame(checker_bench)
    model = BenchModel(settings_of(checker_bench), reconstructor)

    class Uniform:
        """The same model, with the field's phase alone."""

        sample_x_m, sample_y_m = model.sample_x_m, model.sample_y_m

        def image(self, field: PointField | None) -> NDArray[np.float32]:
            return model.image(field and (lambda x, y: np.asarray(np.exp(1j * np.angle(field(x, y))), np.complex64)))

    displacement = reconstructor.register(frame)
    whole, uniform = (
        rms([*Refinement(reconstructor, each).rounds(displacement, 3)][-1].wavefront.views - bowl.views).mean()
        for each in (model, Uniform())
    )
    assert whole < 0.5 * uniform


@pytest.mark.slow
@pytest.mark.long
def test_model_source_matches_bench_source(checker_bench: SmallBench, bowl: Bowl) -> None:
    """An uneven, blurred checkerboard and unevenly lit lenslets."""
    points = checkerboard()
    uneven = SourcePoints(
        position_m=points.position_m, area_m2=points.area_m2 * (2.5 + points.position_m[:, 0] / HALF_M)
    )
    x = np.arange(checker_bench.frame_shape[1]) / checker_bench.frame_shape[1]

    def image(field: PointField | None) -> NDArray[np.float32]:
        sharp = checker_bench.model.irradiance(uneven, field) * np.float32(1e14)
        return np.asarray(ndimage.gaussian_filter(sharp, 0.7) * (0.6 + 0.8 * x), np.float32)

    reconstructor = checker_bench.reconstructor("cubic", pupil_modes=None, reference=image(None))
    frame = image(bowl.field)
    once = rms(reconstructor(frame).views - bowl.views).mean()
    *_, last = refined(checker_bench, reconstructor, frame)
    assert rms(last.wavefront.views - bowl.views).mean() < 0.4 * once

    model = BenchModel(settings_of(checker_bench), reconstructor)
    subimages, modelled = reconstructor.subimages, Reconstructor.registration_for(reconstructor, model.image(None))
    assert modelled(image(None), saturated=np.zeros(checker_bench.frame_shape, np.bool_)).residual_rms.max() < 0.03
    assert subimages.light.max() == pytest.approx(float(model.image(None).max()), rel=0.1)


def test_model_has_the_own_wavefronts_of_its_lenslets(checker_bench: SmallBench) -> None:
    lenslets = Lenslets(checker_bench, 0.2)
    reconstructor = checker_bench.reconstructor("quadratic", pupil_modes=None, reference=lenslets.image)
    model = BenchModel(settings_of(checker_bench), reconstructor)
    flat = np.ones((len(model.sample_y_m), len(model.sample_x_m)), np.complex64)
    for field in (None, lambda _x, _y: flat):
        left = np.std(model.image(field) - lenslets.image)
        assert left < 0.5 * np.std(checker_bench.reference - lenslets.image)


def test_flat_wavefront_ends_refinement_at_once(checker_bench: SmallBench) -> None:
    reconstructor = checker_bench.reconstructor("quadratic", pupil_modes=None)
    rounds = list(refined(checker_bench, reconstructor, checker_bench.reference, 5))
    assert all(step.change_rad < 1e-3 for step in rounds)
    assert len(rounds) <= 1


@pytest.mark.slow
def test_lost_lenslet_stays_lost_and_neighbours_are_refined(checker_bench: SmallBench, bowl: Bowl) -> None:
    frame = bowl.frame(checker_bench)
    x, y = checker_bench.lattice.lenslet_centers_px(7, 9)[3, 4]
    frame[int(y) - 15 : int(y) + 16, int(x) - 15 : int(x) + 16] = 0
    reconstructor = checker_bench.reconstructor("cubic", pupil_modes=None)
    once = reconstructor(frame)
    *_, last = refined(checker_bench, reconstructor, frame)
    assert np.isnan(last.wavefront.displacement.coefficients[3, 4]).all()
    assert np.isfinite(last.wavefront.views).all()
    assert rms(last.wavefront.views - bowl.views).mean() < 0.4 * rms(once.views - bowl.views).mean()


@pytest.mark.slow
def test_bias_corrects_a_similar_wavefront(checker_bench: SmallBench, bowl: Bowl) -> None:
    reconstructor = checker_bench.reconstructor("cubic", pupil_modes=None)
    *_, last = refined(checker_bench, reconstructor, bowl.frame(checker_bench))
    later = checker_bench.frame(lambda x, y: np.float32(1.05) * bowl.at_samples(x, y), bowl.amplitude)
    once = rms(reconstructor(later).views - 1.05 * bowl.views).mean()
    corrected = reconstructor.solve(reconstructor.register(later), bias=last.bias.displacement)
    assert rms(corrected.views - 1.05 * bowl.views).mean() < 0.4 * once


def test_model_without_light_is_refused(checker_bench: SmallBench) -> None:
    class Dark:
        sample_x_m = sample_y_m = np.linspace(-1e-3, 1e-3, 4)

        def image(self, _field: PointField | None) -> NDArray[np.float32]:
            return np.zeros(checker_bench.frame_shape, np.float32)

    with pytest.raises(ReconstructionError, match="shows no light"):
        Refinement(checker_bench.reconstructor(), Dark())


@pytest.mark.slow
def test_rotated_lattice_is_modelled() -> None:
    turned = SmallBench(5, 6, rotation_rad=-0.03, source=checkerboard())
    other = Bowl(turned)
    reconstructor = turned.reconstructor("cubic", pupil_modes=None)
    frame = other.frame(turned)
    once = rms(reconstructor(frame).views - other.views).mean()
    *_, last = refined(turned, reconstructor, frame)
    assert rms(last.wavefront.views - other.views).mean() < 0.4 * once


def test_refinement_ends_without_improvement(checker_bench: SmallBench, bowl: Bowl) -> None:
    class Wild:
        """A model whose images differ more and more."""

        sample_x_m, sample_y_m = checker_bench.model.sample_x_m, checker_bench.model.sample_y_m
        asked = 0

        def image(self, field: PointField | None) -> NDArray[np.float32]:
            if field is None:
                return checker_bench.reference
            self.asked += 1
            strength = np.float32(0.2 * self.asked**2)
            return checker_bench.frame(lambda x, y: strength * bowl.at_samples(x, y))

    reconstructor = checker_bench.reconstructor("quadratic", pupil_modes=None)
    model = Wild()
    displacement = reconstructor.register(bowl.frame(checker_bench))
    assert len(list(Refinement(reconstructor, model).rounds(displacement, 6))) < model.asked < 6


def test_source_of_a_reference_is_measured_once(small_bench: SmallBench) -> None:
    bench = Bench(sensor=small_bench.sensor, field=small_bench.field, lattice=small_bench.lattice)
    reference = small_bench.subimages()
    assert measured_source(reference, bench) is measured_source(reference, bench)
