"""Samples assumed for recorded frames: their form in `frames.jsonl`, and back."""

import math

import numpy as np

from app.recording.frame_lines import SampleLine
from reconstruction.layers.layered_wavefront import FREE, AssumedSample

_MOST_LAYERS, _MOST_RATIO = 2, 1e4


def sample_line(sample: AssumedSample) -> SampleLine:
    """Form of a sample in the line of a frame, from which `assumed_sample` restores it exactly."""
    covariance = None if sample.covariance is None else tuple(map(tuple, sample.covariance.tolist()))
    return SampleLine(sample.ratios, covariance)


def assumed_sample(line: SampleLine) -> AssumedSample:
    """Sample of a line; `ValueError` if no search can have found it."""
    if not line.ratios:
        return FREE
    numbers, layers = [*line.ratios, *(value for row in line.covariance or () for value in row)], len(line.ratios)
    is_sound = (
        layers <= _MOST_LAYERS
        and len(set(line.ratios)) == layers
        and all(map(math.isfinite, numbers))
        and max(map(abs, line.ratios)) <= _MOST_RATIO
        and (line.covariance is None or [len(row) for row in line.covariance] == [layers] * layers)
    )
    if not is_sound:
        raise ValueError(f"layers at the ratios {', '.join(map(str, line.ratios))} are impossible")
    return AssumedSample(line.ratios, None if line.covariance is None else np.array(line.covariance))
