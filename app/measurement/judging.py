"""Preparation of the judgement of frames from what was made of their reference."""

from reconstruction.arrays import Counts, Image
from reconstruction.frame.noise import TransferCurve
from reconstruction.geometry import Lattice
from reconstruction.pipeline import Reconstructor
from reconstruction.quality.frame_quality import FrameJudge
from reconstruction.quality.reference_quality import (
    linearity_quality,
    reference_quality,
    response_quality,
    sample_quality,
)


def frame_judge(
    reconstructor: Reconstructor,
    reference: Counts,
    *,
    shown: Lattice | None,
    dark: Counts | None,
    variance: Image | None = None,
    frames: float = 1,
    curve: TransferCurve | None = None,
) -> FrameJudge:
    """Judge a reference, and prepare the judgement of frames reconstructed with it; see `reference_quality`.

    `curve` is the variance of its frames against their light.
    """
    sensor = reconstructor.sensor
    return FrameJudge(
        reconstructor.subimages,
        reconstructor.registration,
        sensor=sensor,
        field=reconstructor.field,
        dark=dark,
        of_reference=sample_quality(reconstructor.subimages)
        | linearity_quality(curve, "reference")
        | reference_quality(
            reference,
            sensor=sensor,
            lattice=reconstructor.lattice,
            shown=shown,
            dark=dark,
            variance=variance,
            noise=reconstructor.noise,
            frames=frames,
        )
        | response_quality(reconstructor.response_problem),  # named first
    )
