"""Properties of the camera that took the reference and the frames."""

import math
from dataclasses import dataclass

from reconstruction.arrays import Counts
from reconstruction.frame.linearity import Linearity
from reconstruction.frame.noise import KnownNoise


@dataclass(frozen=True, slots=True, eq=False)
class KnownCamera:
    """Dark, saturation, nonlinearity and noise of a camera."""

    dark: Counts | None = None  # (row, column); None: the background is the darkest percent of each image
    full_scale: float = math.inf  # count from which on a pixel is saturated
    linearity: Linearity | None = None  # corrected in every image, dark subtracted
    noise: KnownNoise = KnownNoise()  # of images so corrected
