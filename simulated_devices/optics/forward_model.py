"""Exact image of an incoherent object through a phase screen and a lenslet array.

For one object point x_o the field behind a lenslet is U(u) exp(i k u.x_o / f1), U that of the light behind the sample,
sampled at n x n cell centres u; its image at the focal position y is I(y) = |sum_u field(u) exp(-i k u.y / f)|^2.
Points add up by their area.

The image of n samples is exactly a trigonometric polynomial with 2n - 1 terms a side and period lambda f n / D, so
that 2n positions a side define it. All object points are therefore summed on one grid, symmetric about the lenslet's
axis (`ImageSum`), and the camera's pixels are evaluated once at the end. On symmetric grids the transform splits into
real cosines and sines. "Folded" images are four sums, from which the four mirror-symmetric positions (+-y, +-x) follow.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Event, Lock
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image, PointField
from reconstruction.geometry import Arrangement, Field, Lattice, Sensor, centered_steps, require
from reconstruction.runtime.threads import THREADS, one_blas_thread
from simulated_devices.optics._pixel_grid import PixelGrid
from simulated_devices.optics.compiled import compiled
from simulated_devices.optics.source import SourcePoints


class ImageSum:
    """Accumulates |Fourier transform|^2 of every lenslet's field, point by point, in one thread.

    The four sums are (4, y, lenslet_row, lenslet_column, x) with y and x the positive half of the 2n positions.
    """

    def __init__(self, aperture: Floats, lenslet_rows: int, lenslet_columns: int) -> None:
        """Prepare for lenslets with this amplitude (sample_row, sample_column), the same about both axes."""
        n, half = len(aperture), len(aperture) // 2
        self._half, self._rows, self._columns = half, lenslet_rows, lenslet_columns
        # k u.y / f = 2 pi u' y' / (2n), u' in pupil samples, y' in steps of the 2n-point grid
        angle = 2 * np.pi / (2 * n) * np.outer(np.arange(half) + 0.5, np.arange(n) + 0.5)
        self._along_x = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)  # each (u, x)
        self._along_y = tuple(np.ascontiguousarray(matrix.T) for matrix in self._along_x)  # each (y, u)
        quarter = aperture[half:, half:].astype(np.float32)
        self._amplitude = None  # 1 everywhere
        if not np.all(quarter == 1):
            self._amplitude = np.tile(np.repeat(quarter, lenslet_rows, axis=0), (1, 2 * lenslet_columns))
        lenslets = lenslet_rows * lenslet_columns
        self.folded: Image = np.zeros((4, n * lenslets * n), np.float32)
        # Work space: allocating it for every point would cost more than the arithmetic.
        width = lenslet_columns * half
        self._field = np.empty((2, 2, half * lenslet_rows, 2 * width), np.float32)  # (re|im, y half, row, column)
        self._parity_y = np.empty_like(self._field[:, 0])
        self._parity = np.empty((2, half * lenslets, half), np.float32)
        self._half_way = np.empty((2, 2, 2, half * lenslets, n), np.float32)  # (y parity, re|im, x parity, ...)
        self._transform = np.empty((2, 2, 2, n, lenslets * n), np.float32)

    def add(self, field: NDArray[np.complex64], weight: float) -> None:
        """Add one object point's image, `weight` times; `field` (row, column) in the order of `ForwardModel`."""
        halves = field.reshape(self._field.shape[1:])
        self._field[0], self._field[1] = halves.real, halves.imag
        if self._amplitude is not None:
            self._field *= self._amplitude
        width = self._field.shape[-1] // 2
        for odd_y, combine_y in enumerate((np.add, np.subtract)):
            combine_y(self._field[:, 1], self._field[:, 0], out=self._parity_y)
            for odd_x, combine_x in enumerate((np.add, np.subtract)):
                parity = self._parity.reshape(2, -1, width)
                combine_x(self._parity_y[..., width:], self._parity_y[..., :width], out=parity)
                for part in range(2):
                    half_way = self._half_way[odd_y, part, odd_x]
                    np.matmul(self._parity[part], self._along_x[odd_x], out=half_way)
                    across = half_way.reshape(self._half, -1)
                    np.matmul(self._along_y[odd_y], across, out=self._transform[odd_y, part, odd_x])
        _add_squares(self._transform.reshape(2, 2, 2, -1), np.float32(weight), self.folded)


@compiled
def _add_squares(transform: Image, weight: np.float32, folded: Image) -> None:
    """Add weight * |F|^2 at the four positions (+-y, +-x), as four sums.

    From the parts a, b, c, d of even/odd y and x:
    F(s_y y, s_x x) = a - i s_x b - i s_y c - s_y s_x d, so |F|^2 = sum of squares + s_y s_x 2 (-Re a d* + Re b c*)
    + s_x 2 Im(a* b ...) + s_y 2 Im(a* c ...), with the signs written out below.
    """
    for k in range(transform.shape[3]):
        ar, ai, br, bi = transform[0, 0, 0, k], transform[0, 1, 0, k], transform[0, 0, 1, k], transform[0, 1, 1, k]
        cr, ci, dr, di = transform[1, 0, 0, k], transform[1, 1, 0, k], transform[1, 0, 1, k], transform[1, 1, 1, k]
        squares = ar * ar + ai * ai + br * br + bi * bi + cr * cr + ci * ci + dr * dr + di * di
        folded[0, k] += weight * squares
        folded[1, k] += weight * (br * cr + bi * ci - ar * dr - ai * di)
        folded[2, k] += weight * (ar * bi - ai * br + cr * di - ci * dr)
        folded[3, k] += weight * (ar * ci - ai * cr + br * di - bi * dr)


def unfold(folded: Image, lenslet_rows: int, lenslet_columns: int) -> Image:
    """Turn the four sums into images of 2n x 2n positions: (lenslet_row, lenslet_column, y, x)."""
    n = math.isqrt(folded.shape[1] // (lenslet_rows * lenslet_columns))
    squares, both, only_x, only_y = folded.reshape(4, n, lenslet_rows, lenslet_columns, n).transpose(0, 2, 3, 1, 4)
    images = np.empty((lenslet_rows, lenslet_columns, 2 * n, 2 * n), np.float32)
    for sign_y, along_y in ((-1, slice(n - 1, None, -1)), (1, slice(n, None))):
        for sign_x, along_x in ((-1, slice(n - 1, None, -1)), (1, slice(n, None))):
            images[:, :, along_y, along_x] = squares + 2 * (sign_y * sign_x * both + sign_x * only_x + sign_y * only_y)
    return images


_PARTS = 16  # of a sample, along each axis


def lenslet_aperture(arrangement: Arrangement, pupil_samples: int) -> Floats:
    """Share of each sample about a lenslet that lies in its aperture, (sample_row, sample_column).

    The samples, `pupil_samples` or a few more to a pitch, fill a square of `Sensor.aperture_width_m`. A square lattice
    has square lenslets, a hexagonal one hexagons that tile it, with corners at +-y.
    """
    if arrangement == "square":
        return np.ones((pupil_samples, pupil_samples))
    samples = 2 * math.ceil(pupil_samples / math.sqrt(3))
    along = np.abs(centered_steps(samples * _PARTS)) / (samples * _PARTS)  # over the whole width
    inside = (along <= np.sqrt(3) / 4) & (along[:, None] <= 0.5 - along / np.sqrt(3))
    return np.asarray(inside.reshape(samples, _PARTS, samples, _PARTS).mean(axis=(1, 3)))


OnFraction: TypeAlias = Callable[[float], None]
"""Progress callback; receives the share that is done, 0 ... 1."""

_Share = TypeVar("_Share")


class ForwardModel:
    """Optics of one sensor, lattice and field, prepared once; thread-safe.

    The camera has `shape` (row, column) pixels. `pixel_fill_factor` is the width of a pixel's sensitive square over the
    pixel pitch; 0 samples the image at the pixels' centres. `border_lenslets` rings of lenslets around the sensor's own
    are lit and imaged, too.
    """

    def __init__(
        self,
        sensor: Sensor,
        lattice: Lattice,
        field: Field,
        *,
        shape: tuple[int, int],
        pupil_samples: int,
        pixel_fill_factor: float,
        border_lenslets: int = 0,
        threads: int = THREADS,
    ) -> None:
        require(
            {
                "pupil_samples must be even and at least 4": pupil_samples >= 4 and pupil_samples % 2 == 0,
                "pixel_fill_factor must lie between 0 and 1": 0 <= pixel_fill_factor <= 1,
            }
        )
        self._sensor = sensor
        self._threads = threads
        self.camera_shape = shape
        self._aperture = lenslet_aperture(sensor.arrangement, pupil_samples)
        self._samples = samples = len(self._aperture)
        # Positions of a hexagonal lattice are every second one of a rectangular lattice with half the pitch along x;
        # an even number of rows more keeps its odd rows odd.
        part = 1 if sensor.arrangement == "square" else 2
        self._lenslet_rows = sensor.lenslets[0] + 2 * part * math.ceil(border_lenslets / part)
        lenslet_columns = sensor.lenslets[1] + 2 * border_lenslets
        self._lenslet_columns = lenslet_columns * part
        self._pixels = PixelGrid(
            sensor,
            lattice,
            lenslets=(self._lenslet_rows, lenslet_columns),
            shape=shape,
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

    def phase_of_lenslets(self, coefficients: Floats) -> Floats:
        """Phase that the sensor's lenslets add, rad, at `sample_y_m` x `sample_x_m`.

        `coefficients` (lenslet_row, lenslet_column, n, m) of P_m(xi) P_n(eta), xi and eta +-1 at the aperture's edges.
        """
        sensor, samples = self._sensor, self._samples
        part = 1 if sensor.arrangement == "square" else 2
        row, column = np.indices(coefficients.shape[:2])
        row += (self._lenslet_rows - sensor.lenslets[0]) // 2
        column = part * column + row % part + (self._lenslet_columns - part * sensor.lenslets[1]) // 2
        of_places = np.zeros((self._lenslet_rows, self._lenslet_columns, *coefficients.shape[2:]))
        of_places[row, column] = coefficients
        of_x = np.tile(np.repeat(np.arange(self._lenslet_columns), samples // 2), 2)
        of_y = np.tile(np.arange(self._lenslet_rows), samples)
        half_m, (n, m) = sensor.aperture_width_m / 2, coefficients.shape[2:]
        along_x = np.polynomial.legendre.legvander(self._local_x_m / half_m, m - 1)
        along_y = np.polynomial.legendre.legvander(self._local_y_m / half_m, n - 1)
        phase = np.einsum("yxnm,yn,xm->yx", of_places[of_y[:, None], of_x], along_y, along_x, optimize=True)
        return np.asarray(phase)

    def irradiance(
        self, source: SourcePoints, field: PointField | None = None, *, progress: OnFraction | None = None
    ) -> Image:
        """Image of `source` on the camera, (row, column), m^2; without `field` it is the reference.

        A pixel's value is the emitting area (m^2) whose light, collected by one lenslet, reaches that pixel: over one
        lenslet's diffraction pattern the values add up to `source.area_m2.sum()`. Multiplied by the photons that one
        lenslet collects per second and m^2 of mask, it is photons per second. `field` is any function of the object
        point that returns the field at `sample_y_m` x `sample_x_m`. `progress` receives 0 ... 1, from any thread but
        one at a time; an exception that it raises ends the rendering and is raised here.
        """
        alone = field is None  # without a sample all lenslets see the same
        folded = self._accumulate(source, field, progress or (lambda _: None))
        shape = (1, 1) if alone else (self._lenslet_rows, self._lenslet_columns)
        waves = self._pixels.waves(unfold(folded, *shape))
        return np.asarray(self._pixels.evaluate(waves[:, None])[0])

    def point_irradiances(self, position_m: Floats, field: PointField | None = None) -> Image:
        """Images (point, row, column) of points (point, xy): `irradiance` for 1 m^2 each; 16 points take 40 MB."""
        lenslets = (1, 1) if field is None else (self._lenslet_rows, self._lenslet_columns)
        n = self._samples
        waves = np.empty((lenslets[0] * lenslets[1], len(position_m), 2 * n - 1, 2 * n - 1), np.float32)

        def work(first: int, ended: Event) -> None:
            total = ImageSum(self._aperture, *lenslets)
            for point in range(first, len(position_m), self._threads):
                if ended.is_set():
                    return
                x_m, y_m = (float(value) for value in position_m[point])
                total.folded[:] = 0
                total.add(self._tilted(field, x_m, y_m), 1.0)
                waves[:, point] = self._pixels.waves(unfold(total.folded, *lenslets))

        with one_blas_thread(), ThreadPoolExecutor(self._threads) as pool:
            self._share_out(work, pool)
            return self._pixels.evaluate(waves, pool.map)

    def _accumulate(self, source: SourcePoints, field: PointField | None, progress: OnFraction) -> Image:
        # Points of one object column share the work along x: a thread takes whole columns.
        lit = np.flatnonzero(source.area_m2)  # grids of openings contain dark points
        order = lit[np.argsort(source.position_m[lit, 0], kind="stable")]
        columns = np.split(order, np.flatnonzero(np.diff(source.position_m[order, 0])) + 1)
        done, one_at_a_time = 0, Lock()

        def work(first: int, ended: Event) -> Image:
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
        """Run `work(first, ended)` here and in threads; an exception in one, or Ctrl-C, sets `ended`."""
        ended = Event()

        def share(first: int) -> _Share:
            try:
                return work(first, ended)
            except BaseException:
                ended.set()
                raise

        try:
            others = [pool.submit(share, first) for first in range(1, self._threads)]
            return [share(0), *(other.result() for other in others)]  # Windows lets Ctrl-C interrupt no wait
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
