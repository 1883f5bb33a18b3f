"""Sentences on what was assumed of the sample, and on what the mask shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.gui_bench import make_measurement
from support.optics import FIELD, SmallBench
from support.wavefronts import bowl

from app.measurement.estimator import mask_sentence
from app.measurement.measurement import sample_sentence
from app.results.run_summary import FrameTally
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.settings import ReconstructionSettings, RegistrationSettings

BIAS = "displacements count as mean gradients of the wavefront, whose bias the error bars leave out"


@pytest.mark.parametrize(
    ("ratios", "sigmas", "sentence"),
    [
        ((), None, "any wavefront"),
        ((-0.975,), [0.005], "one layer 195 +- 1 mm in front of the lenslets"),
        ((-0.975,), [0.0026], "one layer 195.0 +- 0.5 mm in front of the lenslets"),
        ((0.15,), None, "one layer 30 mm behind the lenslets"),
        (
            (-1.1, -0.3),
            [0.02, 0.1],
            "two layers 220 +- 4 mm in front of the lenslets and 60 +- 20 mm in front of the lenslets",
        ),
        (
            (-1.1, -0.7, -0.3),
            [0.02, 0.05, 0.1],
            "a sample with depth between 220 +- 4 mm in front of the lenslets and 60 +- 20 mm in front of the lenslets",
        ),
    ],
)
def test_sample_is_told_in_millimetres(ratios: tuple[float, ...], sigmas: list[float] | None, sentence: str) -> None:
    covariance = None if sigmas is None else np.diag(np.square(sigmas))
    assert sample_sentence(AssumedSample(ratios, covariance), FIELD) == sentence


def test_several_frames_name_the_one_whose_distance_is_told() -> None:
    tally, layer = FrameTally(), "one layer {} mm in front of the lenslets"
    for sample, told in (
        (AssumedSample((-0.975,)), layer.format(195)),
        (AssumedSample((-0.97,)), f"{layer.format(194)} (last of 2 frames)"),
        (FREE, f"{layer.format(194)} (last of 2 frames); any wavefront (1 frame)"),
    ):
        wavefront = replace(bowl(), sample=sample, field=FIELD)
        tally.count(replace(make_measurement(np.zeros((2, 3), np.uint16), wavefront.views), wavefront=wavefront))
        assert tally.assumed == told


@pytest.mark.parametrize(
    ("warp", "rotation", "count"),
    [("quadratic", False, 9), ("cubic", False, 14), ("quartic", False, 20), ("cubic", True, 20)],
)
def test_hidden_displacements_are_counted(
    small_bench: SmallBench, checker_bench: SmallBench, warp: str, count: int, *, rotation: bool
) -> None:
    """A uniform square hides displacements of these warps, a checkerboard none."""
    registration = RegistrationSettings(warp=warp, rotation=rotation)  # type: ignore[arg-type] # a warp
    blind = small_bench.reconstructor(registration=registration)
    assert blind.hidden > 0
    shown = f"the mask shows {count - blind.hidden} of {count} deformations of a {warp} warp; the others"
    for sample, others in (
        (FREE, "follow only from the smoothness assumption (large error bars)"),
        (AssumedSample((-0.5,)), "follow from the layer"),
        (None, "follow from what is assumed of the sample"),
    ):
        assert mask_sentence(blind, sample) == f"{shown} {others}{'; ' + BIAS if rotation else ''}"
    if not rotation:
        assert mask_sentence(checker_bench.reconstructor(registration=registration), FREE) == ""


def test_error_bars_that_leave_something_out_are_told(small_bench: SmallBench) -> None:
    affine = small_bench.reconstructor(registration=RegistrationSettings(warp="affine"))
    assert mask_sentence(affine, FREE) == (
        "an affine warp does not show how wavefronts bend over the field; the error bars leave that out"
    )
    zonal = small_bench.reconstructor(
        registration=RegistrationSettings(warp="quadratic"), reconstruction=ReconstructionSettings(method="zonal")
    )
    assert mask_sentence(zonal, FREE).endswith(f"the others are left out, also of the error bars; {BIAS}")
    unknown = small_bench.reconstructor(
        registration=RegistrationSettings(warp="translation"), reconstruction=ReconstructionSettings(response=False)
    )
    assert mask_sentence(unknown, FREE) == (
        f"a translation does not show how wavefronts change over the field; the error bars leave that out; {BIAS}"
    )


def test_neglected_propagation_is_said() -> None:
    field = replace(FIELD, neglect_propagation=True)
    sentence = "any wavefront, and no propagation of light (the paper's simulation)"
    assert sample_sentence(AssumedSample(), field) == sentence
