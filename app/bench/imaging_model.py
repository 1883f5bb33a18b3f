"""Forward models of a bench with its measured source: of one lenslet, and of whole frames."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from app.cache import kept_while_alive
from reconstruction.geometry import Lattice, lenslet_centers
from reconstruction.registration.response import OWN_WAVEFRONTS, mean_subimage, own_wavefronts, point_brightness
from reconstruction.runtime.threads import THREADS
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import SourcePoints

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from app.bench.config import Bench
    from reconstruction.arrays import Floats, Image, PointField
    from reconstruction.reconstructor import Reconstructor
    from reconstruction.registration.subimages import ReferenceSubimages

_POINTS_PER_BLUR = 2.8  # source points per lambda f / D; fewer would be resolved
_MARGIN_POINTS = 1  # on every side of the field: blur of its edge is modelled as source
_SAMPLES_PER_BLUR = 1.35  # pupil samples per lambda f / D of the cell; below 1 its edge is aliased
_LEAST_SAMPLES = 4  # that the forward model accepts


def lenslet_model(bench: Bench, reference: ReferenceSubimages) -> LensletImage:
    """Model of one lenslet with the source that the reference shows; `ReconstructionError` if that allows no model."""
    return lenslet_image(bench, measured_source(reference, bench), reference.width, _pupil_samples(reference))


def lenslet_image(bench: Bench, source: SourcePoints, width: int, samples: int) -> LensletImage:
    """Model of one lenslet of a bench with a source and pupil samples, on `width` x `width` pixels."""
    fill = bench.camera_model.pixel_fill_factor
    return LensletImage(bench.sensor, bench.field, source, width=width, pupil_samples=samples, pixel_fill_factor=fill)


@kept_while_alive(maxsize=4)  # the refinement needs it after the response
def measured_source(reference: ReferenceSubimages, bench: Bench) -> SourcePoints:
    """Brightness of a grid of object points, found in the mean subimage of a reference."""
    # The same lenslets on as many pixels as one window has.
    arrangement, middle_px = bench.sensor.arrangement, (reference.width - 1) / 2
    x_px, y_px = middle_px - lenslet_centers(arrangement, 2, 2)[0, 0] * reference.pitch_px
    one_lenslet = ForwardModel(
        replace(bench.sensor, lenslet_rows=2, lenslet_columns=2),
        Lattice(center_x_px=x_px, center_y_px=y_px, pitch_px=reference.pitch_px, arrangement=arrangement),
        bench.field,
        shape=(reference.width, reference.width),
        pupil_samples=_pupil_samples(reference),
        pixel_fill_factor=bench.camera_model.pixel_fill_factor,
    )
    steps = math.ceil(2 * reference.half_width_px / reference.blur_px * _POINTS_PER_BLUR)
    along_m = (np.arange(-_MARGIN_POINTS, steps + 1 + _MARGIN_POINTS) / steps * 2 - 1) * bench.field.half_width_m
    y_m, x_m = np.meshgrid(along_m, along_m, indexing="ij")
    position_m = np.stack([x_m.ravel(), y_m.ravel()], axis=-1)
    subimage, _ = mean_subimage(reference)
    area_m2 = point_brightness(one_lenslet.point_irradiances(position_m), subimage)
    return SourcePoints(position_m=position_m, area_m2=area_m2)


class BenchModel:
    """Coarse model of one bench; source, light and own wavefronts are estimated from the reference."""

    def __init__(self, bench: Bench, reconstructor: Reconstructor, *, threads: int = THREADS) -> None:
        lattice, reference = reconstructor.lattice, reconstructor.subimages
        self._model = ForwardModel(
            reconstructor.sensor,
            lattice,
            reconstructor.field,
            shape=reconstructor.frame_shape,
            pupil_samples=_pupil_samples(reference),
            pixel_fill_factor=bench.camera_model.pixel_fill_factor,
            threads=threads,
        )
        self.source = measured_source(reference, bench)
        _, light = mean_subimage(reference)
        self._light = by_pixel(light, lattice, *reconstructor.frame_shape)  # counts, (row, column)
        self.sample_x_m, self.sample_y_m = self._model.sample_x_m, self._model.sample_y_m
        own = own_wavefronts(reference, lenslet_model(bench, reference))
        of_lenslets = np.zeros((*reference.lenslets, 4, 4))
        for (n, m), rad in zip(OWN_WAVEFRONTS, own.rad, strict=True):
            of_lenslets[..., n, m] = rad.reshape(reference.lenslets)
        self._own = np.exp(1j * self._model.phase_of_lenslets(of_lenslets)).astype(np.complex64)

    def image(self, field: PointField | None) -> Image:
        """Image of the bench, counts above the dark, (row, column); see `refinement.ImagingModel`."""
        own = self._own

        def of_lenslets(x_m: float, y_m: float) -> NDArray[np.complex64]:
            """Complex amplitude at the pupil samples of the model, (row, column)."""
            return np.asarray(own if field is None else field(x_m, y_m) * own, np.complex64)

        return np.asarray(self._model.irradiance(self.source, of_lenslets) * self._light, np.float32)


def by_pixel(values: Floats, lattice: Lattice, rows: int, columns: int) -> Image:
    """Spread values (lenslet_row, lenslet_column) over pixels (row, column); 0 outside the lattice."""
    row, column = np.mgrid[:rows, :columns]
    cell, _, inside = lattice.cells_at(np.stack([column, row], axis=-1).astype(np.float64), *values.shape)
    cell = np.where(inside[..., None], cell, 0)
    return np.where(inside, values[cell[..., 1], cell[..., 0]], 0.0).astype(np.float32)


def _pupil_samples(reference: ReferenceSubimages) -> int:
    return max(_LEAST_SAMPLES, 2 * math.ceil(_SAMPLES_PER_BLUR * reference.pitch_px / reference.blur_px / 2))
