"""Ways to spoil a measurement of the simulated bench, and the frames that are so made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.arrays import Floats

OFFSET, READ_NOISE_E = 500.0, 5.0
Spoil = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Light:
    """Electrons without noise: of the reference, the frame, and the reference of another mask, (row, column)."""

    reference: Floats
    frame: Floats
    other: Floats


def _same(image: Floats) -> Floats:
    return image


@dataclass(frozen=True)
class Spoiled:
    """What is done to the light of frame and reference, then to their counts, and settings that are wrong."""

    light: Callable[[Light], Light] = lambda light: light
    frame: Spoil = _same  # counts above the dark
    reference: Spoil = _same
    dark: Spoil = _same  # counts
    settings: tuple[str, ...] = ()

    def exposed(
        self, light: Light, seed: int, averaged: int = 1
    ) -> tuple[NDArray[np.uint16], NDArray[Any], NDArray[np.uint16]]:
        """Dark, reference, the mean of so many frames, and frame, counts."""
        generator, changed = np.random.default_rng(seed), self.light(light)

        def counts(image: Floats, spoil: Spoil) -> NDArray[np.uint16]:
            electrons = generator.poisson(np.maximum(image, 0)) + generator.normal(0, READ_NOISE_E, image.shape)
            return np.rint(spoil(electrons) + OFFSET).clip(0, 65535).astype(np.uint16)

        dark = np.rint(self.dark(np.full(light.frame.shape, OFFSET))).astype(np.uint16)
        reference: NDArray[Any] = counts(changed.reference, self.reference)
        if averaged > 1:
            others = [counts(changed.reference, self.reference) for _ in range(averaged - 1)]
            reference = np.asarray(np.mean([reference, *others], axis=0), np.float32)
        return dark, reference, counts(changed.frame, self.frame)


def _frame(spoil: Spoil) -> Spoiled:
    """Spoil the light of the frame."""
    return Spoiled(light=lambda light: replace(light, frame=spoil(light.frame)))


def _reference(spoil: Spoil) -> Spoiled:
    return Spoiled(light=lambda light: replace(light, reference=spoil(light.reference)))


def _both(spoil: Spoil) -> Spoiled:
    return Spoiled(frame=spoil, reference=spoil)


def _across(image: Floats) -> Floats:
    return np.broadcast_to(np.linspace(-1, 1, image.shape[1]), image.shape)


def _ramp(share: float) -> Spoil:
    """Light that falls by that share from left to right."""
    return lambda image: image * (1 - share * (1 + _across(image)) / 2)


def _vignetting(share: float) -> Spoil:
    def spoil(image: Floats) -> Floats:
        y = np.linspace(-1, 1, image.shape[0])[:, None]
        return image * (1 - share * (_across(image) ** 2 + y**2) / 2)

    return spoil


def _gamma(exponent: float) -> Spoil:
    return lambda image: image.max() * (np.maximum(image, 0) / image.max()) ** exponent


def _register(wells: float) -> Callable[[float], Spoil]:
    """Saturation at `wells` times the brightest reference's counts, given."""
    return lambda peak: lambda image: wells * peak * (1 - np.exp(-np.maximum(image, -peak) / (wells * peak)))


def _smear(share: float) -> Spoil:
    """Charge left behind: each pixel keeps back that share for the next one in its row."""

    def spoil(image: Floats) -> Floats:
        out, kept = np.empty_like(image), np.zeros(len(image))
        for column in range(image.shape[1]):
            whole = image[:, column] + kept
            kept = share * whole
            out[:, column] = whole - kept
        return out

    return spoil


def _ghost(share: float, image_of: Spoil) -> Spoil:
    return lambda image: (1 - share) * image + share * image_of(image)


def _zoomed(factor: float) -> Spoil:
    def spoil(image: Floats) -> Floats:
        middle = (np.array(image.shape) - 1) / 2
        return ndimage.affine_transform(image, np.eye(2) / factor, middle * (1 - 1 / factor), order=3, mode="nearest")

    return spoil


def _turned(degrees: float) -> Spoil:
    return lambda image: ndimage.rotate(image, degrees, reshape=False, order=3, mode="nearest")


def _lost_row(image: Floats) -> Floats:
    middle = len(image) // 2
    return np.concatenate([image[:middle], image[middle + 1 :], image[-1:]])


def _set_part(rows: slice, columns: slice, value: float) -> Spoil:
    def spoil(image: Floats) -> Floats:
        out = image.copy()
        out[rows, columns] = value
        return out

    return spoil


def _hot(share: float) -> Spoil:
    def spoil(image: Floats) -> Floats:
        out = image.copy()
        out.ravel()[np.random.default_rng(5).choice(out.size, int(share * out.size), replace=False)] = 2 * image.max()
        return out

    return spoil


def _old_rows(light: Light) -> Light:
    frame = light.frame.copy()
    frame[1::2] = light.reference[1::2]
    return replace(light, frame=frame)


def _torn(light: Light) -> Light:
    frame, middle = light.frame.copy(), len(light.frame) // 2
    frame[:middle] = light.reference[:middle]
    return replace(light, frame=frame)


def _half_in(light: Light) -> Light:
    reference, middle = light.reference.copy(), light.frame.shape[1] // 2
    reference[:, :middle] = light.frame[:, :middle]
    return replace(light, reference=reference)


def _bypassing(share: float) -> Callable[[Light], Light]:
    return lambda light: replace(light, frame=(1 - share) * light.frame + share * light.reference)


def _absorbed(wells: float, share: float) -> Callable[[float], Spoiled]:
    """A sample that absorbs, and a register that saturates for both frames."""

    def kind(peak: float) -> Spoiled:
        spoil = _register(wells)(peak)
        return Spoiled(
            light=lambda light: replace(light, frame=(1 - share) * light.frame), frame=spoil, reference=spoil
        )

    return kind


def _of_the_reference() -> Iterator[tuple[str, Spoiled]]:
    yield "exchanged", Spoiled(light=lambda it: replace(it, reference=it.frame, frame=it.reference))
    yield "sample in the reference", Spoiled(light=lambda it: replace(it, reference=it.frame))
    yield "sample half in the reference", Spoiled(light=_half_in)
    yield "other mask in the reference", Spoiled(light=lambda it: replace(it, reference=it.other))


def _of_the_response(peak_e: float) -> Iterator[tuple[str, Spoiled]]:
    for wells in (2.0, 1.0, 0.5):
        yield f"register {wells:g}, frame", Spoiled(frame=_register(wells)(peak_e))
        for share in (0.1, 0.3, 0.5):
            yield f"register {wells:g}, both, absorbs {share:g}", _absorbed(wells, share)(peak_e)
    for exponent in (0.45, 0.8, 0.9, 1.2, 2.2):
        yield f"gamma {exponent:g}, frame", Spoiled(frame=_gamma(exponent))
        yield f"gamma {exponent:g}, both", _both(_gamma(exponent))
    for share in (0.01, 0.1):
        yield f"smear {share:g}, frame", Spoiled(frame=_smear(share))
        yield f"smear {share:g}, both", _both(_smear(share))


def _of_the_light() -> Iterator[tuple[str, Spoiled]]:
    for share in (0.03, 0.1, 0.3):
        mirrored = _ghost(share, np.fliplr)
        yield f"ghost mirrored, {share:g}", _frame(mirrored)
        yield f"ghost moved by (6, 9), {share:g}", _frame(_ghost(share, lambda it: np.roll(it, (6, 9), (0, 1))))
        yield (
            f"ghost mirrored, both, {share:g}",
            Spoiled(
                light=lambda it, add=mirrored: replace(it, frame=add(it.frame), reference=add(it.reference))  # type: ignore[misc] # mypy and defaults
            ),
        )
    for share in (0.3, 0.7):
        yield f"vignetting {share:g}, frame", _frame(_vignetting(share))
        yield f"vignetting {share:g}, reference", _reference(_vignetting(share))
    for share in (0.3, 0.6):
        yield f"gradient {share:g}, frame", _frame(_ramp(share))
        yield f"gradient {share:g}, reference", _reference(_ramp(share))
    yield "other mask, frame", Spoiled(light=lambda it: replace(it, frame=it.other))
    for share in (0.1, 0.2, 0.5):
        yield f"bypassing light {share:g}", Spoiled(light=_bypassing(share))
    yield "third blocked", _frame(_set_part(slice(None), slice(80), 0.0))


def _of_the_geometry() -> Iterator[tuple[str, Spoiled]]:
    yield "mirrored", _frame(np.fliplr)
    yield "upside down", _frame(np.flipud)
    yield "turned by 180", _frame(lambda image: image[::-1, ::-1])
    for pixels in (1, 4):
        yield f"moved by {pixels} px", _frame(partial(np.roll, shift=pixels, axis=1))
        yield f"blurred by {pixels} px", _frame(partial(ndimage.gaussian_filter, sigma=pixels / 2))
        yield f"motion of {1 + 2 * pixels} px", _frame(partial(ndimage.uniform_filter1d, size=1 + 2 * pixels))
    for factor in (1.003, 1.01):
        yield f"zoom {factor:g}", _frame(_zoomed(factor))
    for degrees in (0.2, 1.0):
        yield f"turned by {degrees:g}", _frame(_turned(degrees))
    yield "lost row", Spoiled(frame=_lost_row)
    yield "every second row old", Spoiled(light=_old_rows)
    yield "torn", Spoiled(light=_torn)


def _of_the_pixels(peak_e: float) -> Iterator[tuple[str, Spoiled]]:
    yield "packets lost", Spoiled(frame=_set_part(slice(96, 128), slice(None), -OFFSET))
    yield "dead row", Spoiled(frame=_set_part(slice(100, 101), slice(None), 0.0))
    for share in (0.001, 0.01):
        yield f"hot pixels {share:g}", Spoiled(frame=_hot(share))
    for share in (0.5, 0.8):
        yield f"clipped at {share:g}", Spoiled(frame=partial(np.minimum, share * peak_e))
    yield "8 bits", _both(lambda image: np.rint(image / peak_e * 200) / 200 * peak_e)
    yield "byte swap", Spoiled(frame=lambda it: np.rint(it).clip(0, 65535).astype(np.uint16).byteswap().astype(float))
    for share in (0.02, 0.1):
        yield f"stray light {share:g}", Spoiled(frame=partial(np.add, share * peak_e))
        yield f"dark too high {share:g}", Spoiled(dark=partial(np.add, share * peak_e))


def _of_the_bench() -> Iterator[tuple[str, Spoiled]]:
    for what, x_px, pitch_px in (
        ("0.25 pitches off", 135.3, 31.25),
        ("1 pitch off", 158.75, 31.25),
        ("5 %", 127.5, 32.8),
    ):
        lattice = (f"lattice.center_x_px={x_px}", "lattice.center_y_px=119.5", f"lattice.pitch_px={pitch_px}")
        yield f"stale lattice, {what}", Spoiled(settings=lattice)
    for what, setting in (
        ("wavelength", "sensor.wavelength_m=592e-9"),
        ("focal length", "sensor.lenslet_focal_length_m=60e-3"),
        ("collimator", "field.collimator_focal_length_m=0.26"),
    ):
        yield f"wrong {what}", Spoiled(settings=(setting,))


def kinds(peak_e: float) -> Iterator[tuple[str, Spoiled]]:
    """All ways to spoil frames whose reference has so many electrons in its brightest pixel."""
    yield from _of_the_reference()
    yield from _of_the_response(peak_e)
    yield from _of_the_light()
    yield from _of_the_geometry()
    yield from _of_the_pixels(peak_e)
    yield from _of_the_bench()
