"""Nonlinearity of a camera: its curve, from the settings of the bench.

A pixel with the signal S, counts above the dark, has received the light L = S (1 + a S/h + b (S/h)^2), in counts of a
faint signal; h is the highest signal of the measurement, beyond which the curve goes on straight.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray
from typing_extensions import Doc

from reconstruction.annotated_settings import Checked
from reconstruction.arrays import Image


@dataclass(frozen=True, slots=True, kw_only=True)
class Linearity(Checked):
    """Nonlinearity of the camera, of `svwfs calibrate --linearity`; q is the signal over the highest one."""

    quadratic: Annotated[float, Ge(-0.5), Le(0.5), Doc("Coefficient in signal (1 + quadratic q + cubic q^2)")]
    cubic: Annotated[float, Ge(-0.5), Le(0.5)] = 0.0
    highest_counts: Annotated[float, Gt(0), Le(1e9), Doc("Highest signal of the measurement, above the dark")]
    quadratic_sigma: Annotated[float, Ge(0), Le(1), Doc("Standard error of quadratic")] = 0.0
    cubic_sigma: Annotated[float, Ge(0), Le(1), Doc("Standard error of cubic")] = 0.0
    chi_square: Annotated[float, Ge(0), Le(1e9), Doc("Reduced chi-square of the measurement")] = 1.0
    amplifier: Annotated[str, Doc("Camera's amplifier in the measurement; none: unknown")] = ""
    em_gain: Annotated[float, Ge(1), Le(1e6), Doc("EM gain in the measurement")] = 1.0

    def faults(self) -> Any:
        """Yield settings that contradict others, and why."""
        share = np.linspace(0, 1, 101)
        if np.min(1 + 2 * self.quadratic * share + 3 * self.cubic * share**2) <= 0:
            yield "quadratic", "and cubic make the light fall while the signal rises"

    @property
    def curve(self) -> Image:
        """Coefficients of S^2 and S^3, the highest signal, and the slope there, (4,)."""
        highest, end = self.highest_counts, 1 + 2 * self.quadratic + 3 * self.cubic
        return np.array([self.quadratic / highest, self.cubic / highest**2, highest, end], np.float32)

    def light(self, signal: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Light from the signal, both counts above the dark, of any shape."""
        square, cube, highest, end = (signal.dtype.type(each) for each in self.curve)
        within = np.minimum(signal, highest)
        return np.asarray(within * (1 + within * (square + within * cube)) + (signal - within) * end)

    def slope(self, signal: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Change of the light with the signal, counts above the dark, of any shape.

        Its square turns the variance of the signal into that of the light.
        """
        square, cube, highest, _ = (signal.dtype.type(each) for each in self.curve)
        within = np.minimum(signal, highest)
        return np.asarray(1 + within * (2 * square + within * 3 * cube))

    @property
    def sentence(self) -> str:
        """The curve in words."""
        change = self.quadratic + self.cubic
        return f"the light is {100 * change:+.2f} % off the signal at {self.highest_counts:.0f} counts above the dark"


LINEAR = np.array([0.0, 0.0, np.inf, 1.0], np.float32)  # curve of a linear camera
