"""The measurement matrix of a Shack-Hartmann sensor: the image of every object point, as the columns of one matrix.

Feng et al. call a column a SH PSF: the irradiance of the whole camera for one point of the object plane. An object
is a vector of the emitting area behind each point; matrix times object is the camera's irradiance, so that, the matrix
once built, any object behind the same screen costs one product. With 37 x 37 points and 465 x 465 pixels it is
1.2 GB, so it is never in memory as a whole: it is computed block by block of points (`StreamedMatrix`), or kept on
disk as a Zarr v3 array (`StoredMatrix`), a block a chunk, each chunk with its checksum.
"""

from __future__ import annotations

import shutil
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec

from reconstruction.arrays import Floats
from reconstruction.geometry import require
from simulated_devices.optics.forward_model import ForwardModel, PointPhase

Images = NDArray[np.float32]

_BLOCK_POINTS = 16  # 14 MB of a 465 x 465 camera, and enough rows for an efficient matrix product

Progress = Callable[[float], None]


class MeasurementMatrix(ABC):
    """Irradiance per object point; `shape` is (point, row, column), dimensionless: m^2 on a pixel per m^2 emitting."""

    shape: tuple[int, int, int]
    position_m: Floats  # (point, xy)

    @abstractmethod
    def block(self, start: int, end: int) -> Images:
        """Return the images of the points start ... end - 1, (point, row, column)."""

    def blocks(self, *, progress: Progress | None = None) -> Iterator[tuple[int, Images]]:
        """Yield the matrix in blocks of points, each with its first point's number; `progress` hears 0 ... 1."""
        points = self.shape[0]
        for start in range(0, points, _BLOCK_POINTS):
            end = min(start + _BLOCK_POINTS, points)
            yield start, self.block(start, end)
            if progress is not None:
                progress(end / points)

    def multiply(self, area_m2: Floats, *, progress: Progress | None = None) -> Images:
        """Irradiance (row, column), m^2, float32, of an object with that emitting area (m^2) behind each point.

        The same as `ForwardModel.irradiance` of these points, to rounding; `SourcePoints.area_m2` is an object.
        """
        points, rows, columns = self.shape
        require(
            {
                f"an object must be one emitting area for each of the {points} points": area_m2.shape == (points,),
                "an object's emitting areas must be finite": bool(np.isfinite(area_m2).all()),
            }
        )
        # float64: a sum over blocks must not round more coarsely than one over points
        total = np.zeros(rows * columns)
        for start, images in self.blocks(progress=progress):
            total += area_m2[start : start + len(images)].astype(np.float32) @ images.reshape(len(images), -1)
        return total.reshape(rows, columns).astype(np.float32)


class StreamedMatrix(MeasurementMatrix):
    """The matrix of one forward model behind one phase (none: the reference), computed anew each time it is used."""

    def __init__(self, model: ForwardModel, position_m: Floats, phase: PointPhase | None = None) -> None:
        require(
            {
                "position_m must be one (x, y) a point": (
                    position_m.ndim == 2 and position_m.shape[1] == 2 and len(position_m) > 0
                )
            }
        )
        self.position_m = position_m
        self.shape = len(position_m), *model.camera_shape
        self._model, self._phase = model, phase

    def block(self, start: int, end: int) -> Images:
        """Compute the images of the points start ... end - 1, (point, row, column)."""
        return self._model.point_irradiances(self.position_m[start:end], self._phase)


class StoredMatrix(MeasurementMatrix):
    """A matrix on disk, complete; opening or reading one that is damaged is a `ValueError` of one sentence."""

    def __init__(self, path: Path) -> None:
        try:
            array = zarr.open_array(str(path), mode="r", zarr_format=3)
            position_m = np.array(array.attrs["position_m"], np.float64)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not a measurement matrix: {_first_line(error)}") from error
        require(
            {
                f"{path} is not a measurement matrix: it is no float32 array (point, row, column)": (
                    array.ndim == 3 and array.dtype == np.float32
                ),
                f"{path} is not a measurement matrix: it has not one (x, y) for each point": (
                    position_m.shape == (array.shape[0], 2)
                ),
                f"{path} is incomplete: {array.nchunks_initialized} of {array.nchunks} blocks are there": (
                    array.nchunks_initialized == array.nchunks
                ),
            }
        )
        self.path = path
        self.position_m = position_m
        self.shape = cast("tuple[int, int, int]", array.shape)
        self._array: zarr.Array[Any] = array

    @classmethod
    def write(cls, path: Path, matrix: MeasurementMatrix, *, progress: Progress | None = None) -> Self:
        """Write `matrix` to the folder `path`, which appears when it is complete; another one there is replaced.

        What `progress` raises ends it, and nothing is left behind.
        """
        if path.exists():
            try:
                cls(path)
            except ValueError as error:
                raise ValueError(f"{path} exists and is no measurement matrix; it is left alone") from error
        part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
        try:
            array = zarr.create_array(
                str(part),
                shape=matrix.shape,
                chunks=(min(_BLOCK_POINTS, matrix.shape[0]), *matrix.shape[1:]),
                dtype=np.float32,
                compressors=[Crc32cCodec()],  # full-precision light does not compress; a bad disk must not go unseen
                attributes={"position_m": matrix.position_m.tolist()},
                config={"write_empty_chunks": True},  # a block that is missing is a fault, not darkness
                zarr_format=3,
            )
            for start, images in matrix.blocks(progress=progress):
                array[start : start + len(images)] = images
            old = part.with_suffix(".old")
            if path.exists():
                path.rename(old)
            part.rename(path)
            shutil.rmtree(old, ignore_errors=True)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return cls(path)

    def block(self, start: int, end: int) -> Images:
        """Read the images of the points start ... end - 1, (point, row, column)."""
        if self._array.nchunks_initialized < self._array.nchunks:  # zarr would read darkness
            raise ValueError(f"{self.path} is damaged: a block has gone")
        try:
            return np.asarray(self._array[start:end], np.float32)
        except (OSError, ValueError) as error:
            raise ValueError(f"{self.path} is damaged: {_first_line(error)}") from error


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
