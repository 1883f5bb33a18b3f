"""What was assumed of the sample, and what the mask shows, in words."""

import math

from reconstruction.geometry import Field
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.pipeline import Reconstructor
from reconstruction.settings import FIELD_MODES

_COUNTS = {1: "one layer", 2: "two layers"}


def sample_sentence(sample: AssumedSample, field: Field) -> str:
    """Say what was assumed, as "one layer 195 +- 1 mm in front of the lenslets"."""
    neglected = ", and no propagation of light (the paper's simulation)" if field.neglect_propagation else ""
    if not sample.ratios:
        return f"any wavefront{neglected}"
    places = [
        _place(-ratio * field.collimator_focal_length_m, sigma * field.collimator_focal_length_m)
        for ratio, sigma in zip(sample.ratios, sample.sigma.tolist(), strict=True)
    ]
    return f"{_COUNTS[len(places)]} {' and '.join(places)}{neglected}"


def mask_sentence(reconstructor: Reconstructor, sample: AssumedSample | None = None) -> str:
    """Say which displacements mask or warp leave out, and what they follow from; empty if all are shown.

    Also say if the bias of mean gradients is left out. Without a `sample`, of frames in general.
    """
    return "; ".join(filter(None, [_left_out(reconstructor, sample), _bias(reconstructor)]))


def _bias(reconstructor: Reconstructor) -> str:
    registration, reconstruction = reconstructor.registration, reconstructor.reconstruction
    knows_response = reconstruction.response and registration.method == "gauss_newton" and not registration.rotation
    if reconstruction.method == "modal" and knows_response:
        return ""
    return "displacements count as mean gradients of the wavefront, whose bias the error bars leave out"


def _left_out(reconstructor: Reconstructor, sample: AssumedSample | None) -> str:
    warp, hidden = reconstructor.registration.warp, reconstructor.hidden
    if warp == "affine":
        return "an affine warp does not show how wavefronts bend over the field; the error bars leave that out"
    if warp is None or not hidden:
        return ""
    fields = FIELD_MODES[warp]
    degree = (math.isqrt(8 * fields + 1) - 3) // 2
    count = 2 * fields if reconstructor.registration.rotation else fields + degree + 1  # gradients of a potential
    if reconstructor.reconstruction.method == "zonal":
        source = "are left out, also of the error bars"
    elif sample is None:
        source = "follow from layers, or only from the prior"
    elif sample.ratios:
        source = "follow from the layer" if len(sample.ratios) == 1 else "follow from the layers"
    else:
        source = "are known only by the prior"
    return f"the mask shows {count - hidden} of {count} displacements of a {warp} warp; the others {source}"


def _place(distance_m: float, sigma_m: float) -> str:
    """Describe a distance, positive towards the source."""
    side = "in front of" if distance_m >= 0 else "behind"
    decimals = 0 if sigma_m <= 0 else max(0, -math.floor(math.log10(sigma_m * 1e3)))
    error = f" +- {sigma_m * 1e3:.{decimals}f}" if sigma_m > 0 else ""
    return f"{abs(distance_m) * 1e3:.{decimals}f}{error} mm {side} the lenslets"
