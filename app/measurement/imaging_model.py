"""Forward model of a bench with its measured source, used by the refinement."""

import math
from dataclasses import replace
from functools import partial

import numpy as np

from app.bench.config import Bench
from reconstruction.arrays import Floats, Image
from reconstruction.geometry import Lattice
from reconstruction.pipeline import Reconstructor
from reconstruction.refinement import PointPhase
from reconstruction.registration.source_brightness import mean_subimage, point_brightness
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.source import SourcePoints

_POINTS_PER_BLUR = 2.8  # source points per lambda f / D; fewer would be resolved
_MARGIN_POINTS = 1  # on every side of the field: blur of its edge is modelled as source
_SAMPLES_PER_BLUR = 1.35  # pupil samples per lambda f / D of the cell; below 1 its edge is aliased


class BenchModel:
    """Coarse model of one bench with one reference; see `refinement.ImagingModel`.

    The brightness of the source and the light of each lenslet are estimated from the reference.
    """

    def __init__(self, bench: Bench, reconstructor: Reconstructor, *, threads: int = 2) -> None:
        sensor, field, lattice = reconstructor.sensor, reconstructor.field, reconstructor.lattice
        reference, (rows, columns) = reconstructor.subimages, reconstructor.frame_shape
        fill_factor = bench.camera_model.pixel_fill_factor
        samples = 2 * math.ceil(_SAMPLES_PER_BLUR * lattice.pitch_px / reference.blur_px / 2)
        forward_model = partial(
            ForwardModel, field=field, pupil_samples=samples, pixel_fill_factor=fill_factor, threads=threads
        )
        self._model = forward_model(sensor, lattice, rows=rows, columns=columns)
        subimage, light = mean_subimage(reference)
        # The same lenslets on as many pixels as one window has.
        middle_px = (reference.width - 1 + lattice.pitch_px) / 2
        one_lenslet = forward_model(
            replace(sensor, lenslet_rows=2, lenslet_columns=2),
            Lattice(center_x_px=middle_px, center_y_px=middle_px, pitch_px=lattice.pitch_px),
            rows=reference.width,
            columns=reference.width,
        )
        steps = math.ceil(2 * reference.half_width_px / reference.blur_px * _POINTS_PER_BLUR)
        along_m = (np.arange(-_MARGIN_POINTS, steps + 1 + _MARGIN_POINTS) / steps * 2 - 1) * field.half_width_m
        y_m, x_m = np.meshgrid(along_m, along_m, indexing="ij")
        position_m = np.stack([x_m.ravel(), y_m.ravel()], axis=-1)
        images = one_lenslet.point_irradiances(position_m)
        self.source = SourcePoints(position_m=position_m, area_m2=point_brightness(images, subimage))
        self._light = by_pixel(light, lattice, rows, columns)  # counts, (row, column)
        self.sample_x_m, self.sample_y_m = self._model.sample_x_m, self._model.sample_y_m

    def image(self, phase: PointPhase | None) -> Image:
        """Image of the bench, counts above the dark, (row, column); see `refinement.ImagingModel`."""
        return np.asarray(self._model.irradiance(self.source, phase) * self._light, np.float32)


def by_pixel(values: Floats, lattice: Lattice, rows: int, columns: int) -> Image:
    """Value (lenslet_row, lenslet_column) of the lenslet of each pixel, (row, column); 0 outside the lattice."""
    row, column = np.mgrid[:rows, :columns]
    position_px = lattice.from_camera_px(np.stack([column, row], axis=-1).astype(np.float64))
    counts = np.array(values.shape[::-1])
    cell = np.floor(position_px / lattice.pitch_px + counts / 2).astype(np.intp)  # (row, column, xy)
    inside = np.all((cell >= 0) & (cell < counts), axis=-1)
    cell = np.where(inside[..., None], cell, 0)
    return np.where(inside, values[cell[..., 1], cell[..., 0]], 0.0).astype(np.float32)
