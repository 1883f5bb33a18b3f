"""Noise of a wavefront's RMS, and the RMS in words."""

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.wavefront import Wavefront


def rms_noise(wavefront: Wavefront) -> Floats:
    """RMS over the lenslets of the standard deviation of the wavefront, rad, (view_row, view_column).

    A wavefront with a smaller RMS cannot be told from a flat one. NaN where the wavefront is unknown.
    """
    variance = wavefront.sigma() ** 2
    known = np.isfinite(variance)
    with np.errstate(invalid="ignore"):
        mean = np.sum(variance, axis=(2, 3), where=known) / np.count_nonzero(known, axis=(2, 3))
    return np.asarray(np.sqrt(mean))


def rms_text(rms_rad: float, noise_rad: float) -> str:
    """Format an RMS, rad, as "0.123 +- 0.007"; without a number if it is below the noise."""
    if rms_rad < noise_rad:
        return f"below noise ({noise_rad:.3f} rad)"
    return f"{rms_rad:.3f} +- {noise_rad:.3f}" if np.isfinite(noise_rad) else f"{rms_rad:.3f}"
