"""The whole reconstruction with the response of the registration, on rendered frames without noise."""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np
import pytest
from support.optics import SmallBench

from app.bench.config import Bench
from app.bench.imaging_model import lenslet_model
from reconstruction.arrays import Floats, Image
from reconstruction.geometry import Field
from reconstruction.pipeline import Reconstructor
from reconstruction.refinement import mean_rms
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from simulated_devices.optics import source
from simulated_devices.settings import Source

Shape = Literal["square", "circle"]
CENTRAL = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, view_spacing_m=0.4e-3)  # views inside the circle


def layer(u: Floats, v: Floats, x: float, y: float) -> Floats:
    """A layer 60 mm before the pupil, of the fifth degree, rad."""
    u, v = (u + 0.3 * x) / 1.75e-3, (v + 0.3 * y) / 1.75e-3
    return np.asarray(1.5 * (u**4 - 2 * u**2 * v**2) + u**3 * v**2 - u * v**4 - 2 * u**2 + 3 * v**3)


@pytest.fixture(scope="module")
def frames(small_bench: SmallBench) -> dict[Shape, tuple[Image, Image]]:
    """Reference and frame of each source."""
    u, v = small_bench.samples()

    def seen(shape: Shape) -> tuple[Image, Image]:
        points = getattr(source, shape)(Source(), object_samples=19)
        frame = small_bench.model.irradiance(points, lambda x, y: layer(u, v, x, y).astype(np.float32))
        return small_bench.model.irradiance(points) * np.float32(1e14), frame * np.float32(1e14)

    return {"square": seen("square"), "circle": seen("circle")}


def reconstructor(bench: SmallBench, reference: Image, *, response: bool = True, **changes: object) -> Reconstructor:
    settings = {
        "registration": RegistrationSettings(warp="quadratic", rotation=False),
        "reconstruction": ReconstructionSettings(response=response),
        "lenslet_model": partial(lenslet_model, Bench(sensor=bench.sensor, field=CENTRAL, lattice=bench.lattice)),
    }
    return Reconstructor(
        reference,
        sensor=bench.sensor,
        lattice=bench.lattice,
        field=CENTRAL,
        **(settings | changes),  # type: ignore[arg-type] # options by name
    )


def error_rad(bench: SmallBench, frame: Image, prepared: Reconstructor) -> float:
    wavefront = prepared(frame)
    assert wavefront.displacement.valid.all()
    truth = np.array(
        [[layer(bench.pupil_x_m, bench.pupil_y_m, x, y) for x in CENTRAL.view_x_m] for y in CENTRAL.view_y_m]
    )
    return mean_rms(wavefront.views - (truth - truth.mean(axis=(2, 3), keepdims=True)))


def test_response_removes_most_of_the_bias(small_bench: SmallBench, frames: dict[Shape, tuple[Image, Image]]) -> None:
    error = {}
    for shape in ("square", "circle"):
        reference, frame = frames[shape]
        for response in (False, True):
            prepared = reconstructor(small_bench, reference, response=response)
            assert prepared.response_problem == ""
            error[shape, response] = error_rad(small_bench, frame, prepared)
    assert error["square", True] < error["square", False] / 3
    assert error["circle", True] < error["circle", False] / 3
    assert error["circle", True] < 1.5 * error["square", True]


def test_reason_is_kept_where_there_is_no_response(small_bench: SmallBench) -> None:
    narrow = Bench(
        sensor=small_bench.sensor,
        field=Field(collimator_focal_length_m=0.2, half_width_m=0.3e-3, view_spacing_m=0.3e-3),
    )
    unlike = small_bench.reconstructor(lenslet_model=partial(lenslet_model, narrow))
    assert "the modelled reference differs from the measured one by" in unlike.response_problem
