"""Measurement matrix of a Shack-Hartmann sensor: a column is the image of an object point.

Feng et al. call a column a SH PSF: the irradiance of the whole camera for one point of the object plane. An object is
a vector of emitting areas, one per point; matrix times object is the camera's irradiance, so that any object behind
the same screen costs one product. With 37 x 37 points and 465 x 465 pixels the matrix takes 1.2 GB: it is kept on disk
as a Zarr v3 array (point, row, column), a block of points per chunk, each chunk with its checksum.
"""

import shutil
import uuid
from pathlib import Path
from typing import Any, Self

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec

from reconstruction.arrays import Floats, PointField
from reconstruction.geometry import require
from simulated_devices.optics.forward_model import ForwardModel, OnFraction

_BLOCK_POINTS = 16  # 14 MB of a 465 x 465 camera, and enough rows for an efficient matrix product


class MeasurementMatrix:
    """A complete matrix on disk, dimensionless: m^2 on a pixel per m^2 emitting.

    Opening a folder that holds none, or only a part of one, raises a `ValueError` of one sentence.
    """

    def __init__(self, path: Path) -> None:
        try:
            array = zarr.open_array(str(path), mode="r", zarr_format=3)
            position_m = np.array(array.attrs["position_m"], np.float64)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not a measurement matrix: {error}") from error
        count = array.nchunks_initialized  # zarr would read the others as darkness
        require({f"{path} is incomplete: {count} of {array.nchunks} blocks are there": count == array.nchunks})
        self.path = path
        self.position_m = position_m  # (point, xy)
        self.shape = array.shape
        self._array: zarr.Array[Any] = array

    @classmethod
    def write(
        cls,
        path: Path,
        model: ForwardModel,
        position_m: Floats,
        field: PointField | None = None,
        *,
        progress: OnFraction | None = None,
    ) -> Self:
        """Compute and write the matrix of `model` behind `field` (None: the reference) for points (point, xy).

        The folder `path`, which may not exist, appears when it is complete. `progress` receives 0 ... 1; an exception
        that it raises ends the computation and leaves nothing behind.
        """
        require(
            {
                "position_m must be one (x, y) a point": position_m.ndim == 2 and position_m.shape[1:] == (2,),
                f"{path} exists: delete it, or choose another name": not path.exists(),
            }
        )
        points = len(position_m)
        part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
        try:
            array = zarr.create_array(
                str(part),
                shape=(points, *model.camera_shape),
                chunks=(min(_BLOCK_POINTS, points), *model.camera_shape),
                dtype=np.float32,
                compressors=[Crc32cCodec()],  # detects disk errors; float32 images do not compress
                attributes={"position_m": position_m.tolist()},
                config={"write_empty_chunks": True},  # a missing block is a fault, not darkness
                zarr_format=3,
            )
            for start in range(0, points, _BLOCK_POINTS):
                end = min(start + _BLOCK_POINTS, points)
                array[start:end] = model.point_irradiances(position_m[start:end], field)
                if progress is not None:
                    progress(end / points)
            part.rename(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return cls(path)

    def block(self, start: int, end: int) -> NDArray[np.float32]:
        """Read the images of the points start ... end - 1, (point, row, column)."""
        return np.asarray(self._array[start:end], np.float32)

    def multiply(self, area_m2: Floats) -> NDArray[np.float32]:
        """Irradiance (row, column), m^2, of an object with that emitting area (m^2) at each point.

        Equals `ForwardModel.irradiance` of these points to rounding; `SourcePoints.area_m2` is such an object.
        """
        points, *camera_shape = self.shape
        require(
            {
                f"an object must be one emitting area for each of the {points} points": area_m2.shape == (points,),
                "an object's emitting areas must be finite": bool(np.isfinite(area_m2).all()),
            }
        )
        total = np.zeros(camera_shape)  # float64: the sum over blocks must not add rounding
        for start in range(0, points, _BLOCK_POINTS):
            images = self.block(start, start + _BLOCK_POINTS)
            total += np.tensordot(area_m2[start : start + len(images)].astype(np.float32), images, axes=1)
        return total.astype(np.float32)
