"""Restoration of blurred, noisy images: Richardson-Lucy and Wiener, stopped where only noise is left.

Both stop at the first estimate whose image differs from the measured one as the noise does (discrepancy principle:
reduced chi-square 1). Light from beyond the edge of the image is part of the unknown object, so that edges do not ring
(Bertero and Boccacci, Astron. Astrophys. 437, 369, 2005).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import Mask
from reconstruction.deconvolution.blur import SpaceVariantBlur, Values
from reconstruction.frame.noise import CameraNoise

OnIteration = Callable[[int, float], None]
"""Receives the number of the iteration and the reduced chi-square before it; NaN if the noise is unknown."""

_UNSEEN = 0.01  # share of a point's light that must reach the image
_TINY = 1e-6  # of the mean light
_GRADIENTS = 8  # conjugate gradients for each strength of the prior
_WEAKER = 0.25  # factor on that strength from one to the next


@dataclass(frozen=True, slots=True, eq=False)
class Restored:
    """An image without blur."""

    image: Values  # light, counts, (row, column)
    iterations: int
    chi_square: float  # reduced, of the image's difference to the blurred result; NaN if the noise is unknown


def richardson_lucy(
    light: Values,
    blur: SpaceVariantBlur,
    *,
    noise: CameraNoise | None,
    counted: Mask,
    iterations: int,
    progress: OnIteration = lambda *_: None,
) -> Restored:
    """Richardson-Lucy: most probable positive object for shot noise.

    Read noise adds its variance to both sides, which makes shot noise of both (Snyder et al., J. Opt. Soc. Am. A 10,
    1014, 1993).

    Parameters
    ----------
    light : (row, column)
        Counts above the dark.
    blur : SpaceVariantBlur
    noise : CameraNoise, optional
        Without it, all iterations are done.
    counted : bool (row, column)
        Pixels whose chi-square ends the iteration.
    iterations : int
        At most.
    progress : callable, optional
    """
    light = np.maximum(light, 0)
    extra = 0.0 if noise is None else noise.read_noise_counts**2 / noise.counts_per_light
    tiny = light.dtype.type(_TINY * light.mean() + 1e-30)
    seen = blur.adjoint(np.ones_like(light))
    gain = np.where(seen > _UNSEEN, 1 / np.maximum(seen, _UNSEEN), 0).astype(light.dtype)
    estimate = np.where(seen > _UNSEEN, light.mean(), 0).astype(light.dtype)
    chi_square, done = np.nan, 0
    for done in range(iterations + 1):
        blurred = np.maximum(blur(estimate), tiny)
        if noise is not None:
            chi_square = _chi_square(light - blurred, noise.variance(blurred), counted)
        progress(done, chi_square)
        if chi_square <= 1 or done == iterations:
            break
        ratio = (light + light.dtype.type(extra)) / (blurred + light.dtype.type(extra))
        estimate *= np.maximum(blur.adjoint(ratio), 0) * gain
    return Restored(_within(estimate, blur), done, chi_square)


def wiener(
    light: Values,
    blur: SpaceVariantBlur,
    *,
    noise: CameraNoise | None,
    counted: Mask,
    iterations: int,
    progress: OnIteration = lambda *_: None,
) -> Restored:
    """Wiener filter for a space-variant blur: the most probable object for white noise and a spectrum of 1/frequency^2.

    The object minimises |light - blurred|^2 + strength |gradient|^2 by conjugate gradients, with a strength that is
    lowered by factors of 4 until the chi-square is 1. Arguments as in `richardson_lucy`.
    """
    if noise is None:
        raise ValueError(
            "the Wiener filter needs the noise, and these pixels are too coarse to show it: give counts_per_electron"
            " and read_noise_counts"
        )
    variance = float(np.mean(noise.variance(light), where=counted))
    estimate = np.full(blur.object_shape, light.mean(), light.dtype)
    strength, done, chi_square = 1.0, 0, np.inf
    while True:
        chi_square = _chi_square(light - blur(estimate), variance, counted)
        progress(done, chi_square)
        if chi_square <= 1 or done >= iterations:
            return Restored(_within(estimate, blur), done, chi_square)
        steps = min(_GRADIENTS, iterations - done)
        estimate, done, strength = regularised(light, blur, strength, estimate, steps), done + steps, strength * _WEAKER


def regularised(light: Values, blur: SpaceVariantBlur, strength: float, start: Values, iterations: int) -> Values:
    """Minimise |light - blurred|^2 + strength |gradient|^2 by conjugate gradients: the object (row, column)."""

    def normal(scene: Values) -> Values:
        return blur.adjoint(blur(scene)) + light.dtype.type(strength) * _stiffness(scene)

    estimate = start
    residual = blur.adjoint(light) - normal(start)
    direction, square = residual, float(np.vdot(residual, residual))
    for _ in range(iterations):
        if square == 0:
            break
        image = normal(direction)
        step = light.dtype.type(square / float(np.vdot(direction, image)))
        estimate, residual = estimate + step * direction, residual - step * image
        square, before = float(np.vdot(residual, residual)), square
        direction = residual + light.dtype.type(square / before) * direction
    return estimate


def _stiffness(scene: Values) -> Values:
    """Gradient of half the squared differences between neighbours."""
    result = np.zeros_like(scene)
    for axis in (0, 1):
        rise = np.diff(scene, axis=axis)
        along = np.moveaxis(result, axis, 0)
        along[1:] += np.moveaxis(rise, axis, 0)
        along[:-1] -= np.moveaxis(rise, axis, 0)
    return result


def _chi_square(difference: Values, variance: Values | float, counted: Mask) -> float:
    return float(np.mean(difference**2 / variance, where=counted, dtype=np.float64))


def _within(scene: Values, blur: SpaceVariantBlur) -> Values:
    """The part of the object that the image shows."""
    reach = blur.reach_px
    return scene[reach : reach + blur.shape[0], reach : reach + blur.shape[1]]
