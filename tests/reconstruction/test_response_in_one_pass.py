"""The whole reconstruction with the response of the registration, on rendered frames without noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal
from unittest.mock import Mock

import numpy as np
import pytest
from support.optics import PAPER, SmallBench
from support.polynomial_layers import light, wavefront

from app.bench.config import Bench
from app.bench.imaging_model import lenslet_model
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field
from reconstruction.layers.layer_search import LayerSearch
from reconstruction.layers.layer_solver import Layer, LayerFit
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.reconstructor import Reconstructor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, SampleModel
from reconstruction.solve.evidence import FitQuality
from reconstruction.wavefront import mean_rms
from simulated_devices.optics import source
from simulated_devices.optics.source import SourcePoints
from simulated_devices.settings import Source

Shape = Literal["square", "circle"]
CENTRAL = replace(PAPER, view_spacing_m=0.4e-3)  # views inside the circle


RATIO = -0.3  # of a layer 60 mm before the lenslets
LAYER = np.zeros((5, 5))  # rad, sum of c[j, i] x^i y^j, x and y in mm, of the fifth degree
for j, i, strength in ((0, 4, 1.5), (2, 2, -3.0), (2, 3, 1.0), (4, 1, -1.0), (0, 2, -2.0), (3, 0, 3.0)):
    LAYER[j, i] = strength / 1.75 ** (i + j)


def seen(bench: SmallBench) -> Image:
    """Frame behind the layer, in real light or in the paper's world."""
    u, v = bench.samples()

    def part(index: int) -> Callable[[float, float], Image]:
        return lambda x, y: light(LAYER, RATIO, u, v, x, y)[index].astype(np.float32)

    return bench.frame(part(0), None if bench.field.neglect_propagation else part(1))


@pytest.fixture(scope="module")
def frames() -> dict[Shape, tuple[Image, Image]]:
    """Reference and frame of each source in the paper's world."""
    sources: dict[Shape, SourcePoints] = {
        "square": source.source_points("square", Source(), object_samples=19),
        "circle": source.source_points("circle", Source(), object_samples=19),
    }
    benches = {shape: SmallBench(field=PAPER, source=points) for shape, points in sources.items()}
    return {shape: (bench.reference, seen(bench)) for shape, bench in benches.items()}


def reconstructor(bench: SmallBench, reference: Image, *, response: bool = True, **changes: object) -> Reconstructor:
    settings = {
        "registration": RegistrationSettings(warp="quadratic", rotation=False),
        "reconstruction": ReconstructionSettings(response=response, sample="free"),
        "lenslet_model": partial(lenslet_model, Bench(sensor=bench.sensor, field=CENTRAL, lattice=bench.lattice)),
    }
    return Reconstructor(
        reference,
        sensor=bench.sensor,
        lattice=bench.lattice,
        field=CENTRAL,
        **(settings | changes),  # type: ignore[arg-type] # options by name
    )


def error_rad(frame: Image, prepared: Reconstructor) -> float:
    found = prepared(frame)
    assert found.displacement.valid.all()
    return mean_rms(found.views - truth_of(CENTRAL))


def truth_of(field: Field) -> Floats:
    return np.array([[wavefront(LAYER, RATIO, x, y) for x in field.view_x_m] for y in field.view_y_m])


@pytest.mark.slow
def test_response_removes_most_of_the_bias(small_bench: SmallBench, frames: dict[Shape, tuple[Image, Image]]) -> None:
    error = {}
    for shape in ("square", "circle"):
        reference, frame = frames[shape]
        for response in (False, True):
            prepared = reconstructor(small_bench, reference, response=response)
            assert prepared.response_problem == ""
            error[shape, response] = error_rad(frame, prepared)
    assert error["square", True] < error["square", False] / 3
    assert error["circle", True] < error["circle", False] / 3
    assert error["circle", True] < 1.5 * error["square", True]


def real_reconstructor(bench: SmallBench, sample: SampleModel) -> Reconstructor:
    """With the response and the warp that the instrument chooses."""
    return bench.reconstructor(
        registration=RegistrationSettings(),
        reconstruction=ReconstructionSettings(sample=sample),
        lenslet_model=partial(lenslet_model, Bench(sensor=bench.sensor, field=bench.field, lattice=bench.lattice)),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sample", "most_rad"),
    [("small_bench", "automatic", 0.003), ("checker_bench", "automatic", 0.003), ("checker_bench", "free", 0.006)],
)
def test_wavefront_is_found_in_real_light(
    request: pytest.FixtureRequest, name: str, sample: SampleModel, most_rad: float
) -> None:
    """The square alone leaves 0.05 rad: the layer is found, and shows what the square hides."""
    bench: SmallBench = request.getfixturevalue(name)
    prepared = real_reconstructor(bench, sample)
    found = prepared(seen(bench))
    error = found.views - truth_of(bench.field)
    assert mean_rms(error) < most_rad < 0.01 * mean_rms(truth_of(bench.field))
    assert np.mean(np.abs(error) < found.sigma()) > 0.6
    if sample == "free":
        assert found.sample is FREE
    else:
        assert found.sample.ratios == pytest.approx((RATIO,), abs=0.003)
    assert (prepared.hidden > 0) == (name == "small_bench")


@pytest.mark.slow
def test_setting_decides_what_is_assumed(checker_bench: SmallBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame that any wavefront explains better than layers do."""
    worse, better = FitQuality(-100.0, 9.0, 0.3), FitQuality(0.0, 1.0, 0.1)
    one = LayerFit((Layer(-0.7, 0.1, np.ones(2), np.zeros(2), np.zeros((2, 2)), 1),), worse, np.full((1, 1), 0.01))
    none = np.zeros(0)
    search = LayerSearch(none, none, none, one, None, None, better)
    search_layers = Mock(return_value=search)
    monkeypatch.setattr("reconstruction.reconstructor.search_layers", search_layers)
    samples = {}
    for setting in ("automatic", "layers", "free"):
        prepared = checker_bench.reconstructor("quadratic", pupil_modes=None, sample=setting)
        samples[setting] = prepared.find_sample(prepared.register(seen(checker_bench)))
    assert samples["automatic"].ratios == samples["free"].ratios == ()
    assert samples["layers"].ratios == (-0.7,)
    assert search_layers.call_count == 2  # not for any wavefront
    fixed = checker_bench.reconstructor("quadratic", pupil_modes=21, sample="automatic")
    assert not fixed.may_be_layered


def test_reason_is_kept_where_there_is_no_response(small_bench: SmallBench) -> None:
    narrow = Bench(
        sensor=small_bench.sensor,
        field=Field(collimator_focal_length_m=0.2, half_width_m=0.3e-3, view_spacing_m=0.3e-3),
    )
    unlike = small_bench.reconstructor(lenslet_model=partial(lenslet_model, narrow))
    assert "the modelled reference differs from the measured one by" in unlike.response_problem


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({"method": "zonal"}, 'reconstruction.method = "zonal"'),
        ({"pupil_modes": 21}, "reconstruction.pupil_modes = 21"),
        (
            {"reconstruction": ReconstructionSettings(basis="zernike", sample="layers")},
            'reconstruction.basis = "zernike"',
        ),
        ({"registration": RegistrationSettings(method="itk_affine")}, 'registration.method = "itk_affine"'),
        ({"warp": "translation"}, 'registration.warp = "translation"'),
    ],
)
def test_layers_are_refused_where_none_can_be_assumed(
    checker_bench: SmallBench, changes: dict[str, Any], setting: str
) -> None:
    with pytest.raises(ReconstructionError, match=f'sample = "layers" is impossible with {setting}: change either'):
        checker_bench.reconstructor(**{"pupil_modes": None, "sample": "layers", **changes})


def test_frame_without_layers_says_why_if_they_are_demanded(checker_bench: SmallBench) -> None:
    """The reference moves nothing."""
    automatic = checker_bench.reconstructor("quadratic", pupil_modes=None, sample="automatic")
    still = replace(automatic.register(checker_bench.reference), coefficients=np.zeros((7, 9, 6, 2)))
    assert automatic.find_sample(still) is FREE
    demanding = checker_bench.reconstructor("quadratic", pupil_modes=None, sample="layers")
    with pytest.raises(ReconstructionError, match=r'there is no layer to find \(.*sample = "layers"\)'):
        demanding.find_sample(still)
