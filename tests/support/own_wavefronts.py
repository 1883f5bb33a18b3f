"""Lenslets with wavefronts of their own, in front of a small bench."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import Legendre

from reconstruction.registration.response import OWN_WAVEFRONTS
from reconstruction.registration.subimages import ReferenceSubimages
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import SourcePoints

if TYPE_CHECKING:
    from reconstruction.arrays import Floats
    from support.optics import SmallBench


def model_of(bench: SmallBench, source: SourcePoints, width: int) -> LensletImage:
    """Model of one lenslet with that source; its light on the window is 1."""

    def model(area_m2: Floats) -> LensletImage:
        points = SourcePoints(position_m=source.position_m, area_m2=area_m2)
        return LensletImage(bench.sensor, bench.field, points, width=width, pupil_samples=12, pixel_fill_factor=1.0)

    return model(source.area_m2 / model(source.area_m2).image().sum())


def local_wave(bench: SmallBench, n: int, m: int) -> Floats:
    """P_n(eta) P_m(xi) over the lenslet of each pupil sample, and its slopes per unit of xi and eta, (3, y, x)."""
    pitch_m = bench.sensor.lenslet_pitch_m
    centre = [(count - 1) / 2 % 1 for count in reversed(bench.sensor.lenslets)]
    along = zip(bench.samples(), centre, strict=True)
    xi, eta = (2 * (at / pitch_m - np.rint(at / pitch_m - middle) - middle) for at, middle in along)
    of_xi, of_eta = Legendre.basis(m), Legendre.basis(n)
    return np.stack([of_xi(xi) * of_eta(eta), of_xi.deriv()(xi) * of_eta(eta), of_xi(xi) * of_eta.deriv()(eta)])


class Lenslets:
    """Lenslets of a bench with random wavefronts of their own, and the reference that they make.

    `rms_rad` is that of each of the `orders` (n, m), `moved_px` that of their displacements along x and y. `uneven` is
    the change of the light from the middle of the frame to its edges, and 20 times an offset. With `electrons` in the
    brightest pixel there is shot noise.
    """

    def __init__(
        self,
        bench: SmallBench,
        rms_rad: float = 0.0,
        *,
        orders: list[tuple[int, int]] = OWN_WAVEFRONTS,
        moved_px: float = 0.0,
        electrons: float = 0.0,
        uneven: float = 0.0,
        excluded: list[tuple[int, int]] | tuple[()] = (),
    ) -> None:
        count = bench.sensor.lenslets
        random, pitch_m = np.random.default_rng(7), bench.sensor.lenslet_pitch_m
        rad = random.normal(0, rms_rad, (len(orders), *count))
        self.rad = rad - rad.mean(axis=(1, 2), keepdims=True)  # what all have counts as the source's shape
        tilt_rad = random.normal(0, moved_px, (2, *count)) * bench.sensor.slope_per_px * pitch_m / 2
        at = zip(bench.samples(), count[::-1], strict=True)
        column, row = (np.rint(m / pitch_m + (along - 1) / 2).astype(int) for m, along in at)
        of_sample = np.concatenate([self.rad, tilt_rad])[:, row, column]
        local = np.stack([local_wave(bench, *order)[0] for order in (*orders, (0, 1), (1, 0))])
        self.phase = np.sum(of_sample * local, axis=0)  # (y, x)
        light = bench.frame(lambda _x, _y: self.phase.astype(np.float32))
        light *= 1 + uneven * np.linspace(-1, 1, light.shape[1], dtype=np.float32)
        light += np.float32(uneven / 20 * light.max())
        if electrons:
            light = random.poisson(light * (electrons / light.max())).astype(np.float32)
        self.image = light
        self.reference = ReferenceSubimages(
            light, sensor=bench.sensor, lattice=bench.lattice, field=bench.field, excluded=excluded
        )
        self.model = model_of(bench, bench.source, self.reference.width)
