"""Sample that was assumed of a frame, as variables and an attribute of its result."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from app.measurement.assumptions import sample_sentence
from app.progress import counted
from app.results.view_quality import Variable, about
from reconstruction.geometry import Field
from reconstruction.layers.layered_wavefront import AssumedSample

_MOST = 2  # layers; the same for all frames, so that they can be stacked


def sample_variables(sample: AssumedSample, of: Field) -> dict[str, Variable]:
    """Return number and distances of the assumed layers; distances are NaN beyond their number."""
    distance_m, sigma_m = np.full((2, _MOST), np.nan)
    count = len(sample.ratios)
    distance_m[:count] = -np.array(sample.ratios) * of.collimator_focal_length_m
    sigma_m[:count] = sample.sigma * of.collimator_focal_length_m
    assumed = "layers that were assumed to make up the sample; 0: any wavefront was allowed"
    towards = "distance of each assumed layer from the lenslets, positive towards the source"
    return {
        "assumed_layers": ((), np.array(count, np.int8), about("1", assumed)),
        "layer_distance": (("layer",), distance_m, about("m", towards)),
        "layer_distance_sigma": (("layer",), sigma_m, about("m", "standard deviation of layer_distance")),
    }


def propagation(field: Field) -> dict[str, str]:
    """Return the attribute that says how light goes from sample to lenslets."""
    return {"propagation_of_light": "neglected" if field.neglect_propagation else "from sample to lenslets"}


@dataclass(slots=True)
class SampleTally:
    """Samples assumed of several frames."""

    _counts: Counter[int] = field(default_factory=Counter)  # frames, by number of layers
    _newest: dict[int, AssumedSample] = field(default_factory=dict)

    def take(self, sample: AssumedSample) -> None:
        """Add one frame."""
        layers = len(sample.ratios)
        self._counts[layers] += 1
        self._newest[layers] = sample

    def sentence(self, of: Field) -> str:
        """Say what was assumed, with the newest distances, and of how many frames if not alike of all."""
        told, is_one = [], len(self._counts) == 1
        for layers, count in self._counts.most_common():
            text, last = sample_sentence(self._newest[layers], of), "last of " * bool(layers and count > 1)
            told.append(text if is_one and not last else f"{text} ({last}{counted(count)})")
        return "; ".join(told)
