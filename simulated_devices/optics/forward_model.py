r"""Exact image of an incoherent object through a phase screen and a lenslet array.

For one object point x_o the field behind a lenslet is U(u) exp(i k u.x_o / f1), U that of the light behind the sample,
sampled at n x n cell centres u; its image at the focal position y is I(y) = |sum_u field(u) exp(-i k u.y / f)|^2.
Points add up by their area.

The image of n samples is exactly a trigonometric polynomial with 2n - 1 terms a side and period lambda f n / D, so
that 2n positions a side define it. All object points are therefore summed on one grid, symmetric about the lenslet's
axis, and the camera's pixels are evaluated once at the end. On symmetric grids the transform splits into real cosines
and sines.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Event, Lock
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Lattice, Sensor, centered_steps, require
from reconstruction.runtime.threads import one_blas_thread
from simulated_devices.optics.aperture import lenslet_aperture
from simulated_devices.optics.image_sum import ImageSum, unfold
from simulated_devices.optics.pixel_grid import PixelGrid
from simulated_devices.optics.source import SourcePoints

Images: TypeAlias = NDArray[np.float32]
PointField: TypeAlias = Callable[[float, float], NDArray[np.complex64]]
"""Field at the pupil samples, (sample_row, sample_column), that the object point (x_m, y_m) has behind the sample.

It has no tilt of its own, and is 1 without a sample.
"""
OnFraction: TypeAlias = Callable[[float], None]
"""Progress callback; receives the share that is done, 0 ... 1."""

_Share = TypeVar("_Share")


class ForwardModel:
    """Optics of one sensor, lattice and field, prepared once; thread-safe.

    `pixel_fill_factor` is the width of a pixel's sensitive square over the pixel pitch; 0 samples the image at the
    pixels' centres. `border_lenslets` rings of lenslets around the sensor's own are lit and imaged, too.
    """

    def __init__(  # noqa: PLR0913 - independent parameters, most with defaults
        self,
        sensor: Sensor,
        lattice: Lattice,
        field: Field,
        *,
        rows: int,
        columns: int,
        pupil_samples: int = 20,
        border_lenslets: int = 0,
        pixel_fill_factor: float = 1.0,
        threads: int = 2,
    ) -> None:
        require(
            {
                "pupil_samples must be even and at least 4": pupil_samples >= 4 and pupil_samples % 2 == 0,
                "pixel_fill_factor must lie between 0 and 1": 0 <= pixel_fill_factor <= 1,
            }
        )
        self._sensor = sensor
        self._threads = threads
        self.camera_shape = rows, columns
        self._aperture = lenslet_aperture(sensor.arrangement, pupil_samples)
        self._samples = samples = len(self._aperture)
        # Positions of a hexagonal lattice are every second one of a rectangular lattice with half the pitch along x;
        # an even number of rows more keeps its odd rows odd.
        part = 1 if sensor.arrangement == "square" else 2
        self._lenslet_rows = sensor.lenslet_rows + 2 * part * math.ceil(border_lenslets / part)
        lenslet_columns = sensor.lenslet_columns + 2 * border_lenslets
        self._lenslet_columns = lenslet_columns * part
        self._pixels = PixelGrid(
            sensor,
            lattice,
            lenslet_rows=self._lenslet_rows,
            lenslet_columns=lenslet_columns,
            rows=rows,
            columns=columns,
            aperture=self._aperture,
            pixel_fill_factor=pixel_fill_factor,
        )
        local_m = centered_steps(samples) * (sensor.aperture_width_m / samples)
        center_x_m = centered_steps(self._lenslet_columns) * (sensor.lenslet_pitch_m / part)
        center_y_m = centered_steps(self._lenslet_rows) * sensor.row_spacing_m
        self._tilt_per_m = sensor.wavenumber_rad_per_m / field.collimator_focal_length_m
        # Order of the even-odd transform: lower half mirrored, then upper half; within a half, columns run lenslet by
        # lenslet, rows sample by sample.
        half = samples // 2
        halves_m = np.stack([local_m[:half][::-1], local_m[half:]])
        self._local_x_m = np.broadcast_to(halves_m[:, None, :], (2, self._lenslet_columns, half)).ravel()
        self._local_y_m = np.broadcast_to(halves_m[:, :, None], (2, half, self._lenslet_rows)).ravel()
        self.sample_x_m: Floats = (halves_m[:, None, :] + center_x_m[None, :, None]).ravel()
        self.sample_y_m: Floats = (halves_m[:, :, None] + center_y_m[None, None, :]).ravel()

    def irradiance(
        self, source: SourcePoints, field: PointField | None = None, *, progress: OnFraction | None = None
    ) -> Images:
        """Image of `source` on the camera, (row, column), float32, in m^2; without `field` it is the reference.

        A pixel's value is the emitting area (m^2) whose light, collected by one lenslet, reaches that pixel: over one
        lenslet's diffraction pattern the values add up to `source.area_m2.sum()`. Multiplied by the photons that one
        lenslet collects per second and m^2 of mask, it is photons per second. `field` is any function of the object
        point that returns the field at `sample_y_m` x `sample_x_m`. `progress` receives 0 ... 1, from any thread but
        one at a time; an exception that it raises ends the rendering and is raised here.
        """
        alone = field is None  # without a sample all lenslets see the same
        folded = self._accumulate(source, field, progress or (lambda _: None))
        shape = (1, 1) if alone else (self._lenslet_rows, self._lenslet_columns)
        return self._pixels.evaluate(unfold(folded, *shape))

    def point_irradiances(self, position_m: Floats, field: PointField | None = None) -> Images:
        """Image of each object point (point, xy): (point, row, column), float32, `irradiance` for 1 m^2 of area each.

        One matrix product per lenslet evaluates all points; 16 points on 465 x 465 pixels take about 40 MB.
        """
        lenslets = (1, 1) if field is None else (self._lenslet_rows, self._lenslet_columns)
        n = self._samples
        waves = np.empty((lenslets[0] * lenslets[1], len(position_m), (2 * n - 1) ** 2), np.float32)

        def work(first: int, ended: Event) -> None:
            total = ImageSum(self._aperture, *lenslets)
            for point in range(first, len(position_m), self._threads):
                if ended.is_set():
                    return
                x_m, y_m = (float(value) for value in position_m[point])
                total.folded[:] = 0
                total.add(self._tilted(field, x_m, y_m), 1.0)
                waves[:, point] = self._pixels.waves(unfold(total.folded, *lenslets)).reshape(len(waves), -1)

        with one_blas_thread(), ThreadPoolExecutor(self._threads) as pool:
            self._share_out(work, pool)
            return self._pixels.evaluate_each(waves, pool.map)

    def _accumulate(self, source: SourcePoints, field: PointField | None, progress: OnFraction) -> Images:
        # Points of one object column share the work along x: a thread takes whole columns.
        lit = np.flatnonzero(source.area_m2)  # grids of openings contain dark points
        order = lit[np.argsort(source.position_m[lit, 0], kind="stable")]
        columns = np.split(order, np.flatnonzero(np.diff(source.position_m[order, 0])) + 1)
        done, one_at_a_time = 0, Lock()

        def work(first: int, ended: Event) -> Images:
            nonlocal done
            lenslets = (1, 1) if field is None else (self._lenslet_rows, self._lenslet_columns)
            total = ImageSum(self._aperture, *lenslets)
            for column in columns[first :: self._threads]:
                for point in column:
                    if ended.is_set():
                        return total.folded
                    x_m, y_m = (float(value) for value in source.position_m[point])
                    total.add(self._tilted(field, x_m, y_m), float(source.area_m2[point]))
                with one_at_a_time:
                    done += len(column)
                    progress(done / max(1, len(order)))
            return total.folded

        with one_blas_thread(), ThreadPoolExecutor(self._threads) as pool:
            parts = self._share_out(work, pool)
        return np.asarray(np.sum(parts, axis=0), np.float32)

    def _share_out(self, work: Callable[[int, Event], _Share], pool: ThreadPoolExecutor) -> list[_Share]:
        """Run `work(first, ended)` in every thread; an exception in one, or Ctrl-C here, sets `ended`."""
        ended = Event()

        def share(first: int) -> _Share:
            try:
                return work(first, ended)
            except BaseException:
                ended.set()
                raise

        try:
            return [future.result() for future in [pool.submit(share, first) for first in range(self._threads)]]
        except BaseException:  # KeyboardInterrupt, too: leaving the pool waits for its threads
            ended.set()
            raise

    def _tilted(self, field: PointField | None, x_m: float, y_m: float) -> NDArray[np.complex64]:
        """Field behind the sample times the object point's tilt over each lenslet, at the pupil samples."""
        local_x_m, local_y_m = self._local_x_m, self._local_y_m
        if field is None:
            half = self._samples // 2
            local_x_m = local_x_m.reshape(2, -1, half)[:, 0].ravel()
            local_y_m = local_y_m.reshape(2, half, -1)[:, :, 0].ravel()
        tilt_x = np.exp(1j * self._tilt_per_m * x_m * local_x_m).astype(np.complex64)
        tilt_y = np.exp(1j * self._tilt_per_m * y_m * local_y_m).astype(np.complex64)
        if field is None:
            return np.outer(tilt_y, tilt_x)
        tilted = field(x_m, y_m) * tilt_x
        tilted *= tilt_y[:, None]
        return np.asarray(tilted, np.complex64)


def phase_only(phase: Callable[[float, float], Images]) -> PointField:
    """Field of uniform light with a phase at the pupil samples, (sample_row, sample_column), rad."""
    return lambda x_m, y_m: np.exp(1j * phase(x_m, y_m)).astype(np.complex64)
